"""What detectors find in recorded data, and how that is measured."""
