"""The sensors and what they see."""
