"""Traffic as frames of oriented prisms, from several sources."""
