"""A page on which sensors are dragged and scores follow."""
