"""Built-in intersections, made from parameters."""
