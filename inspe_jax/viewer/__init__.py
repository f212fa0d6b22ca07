"""A web page on which sensors are dragged and their scores follow."""
