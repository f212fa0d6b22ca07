"""What one sensor sees: its field of view, and the shadows of road users."""
