"""What the sensors of a layout record, frame by frame."""
