"""Where sensors stand: the paper's strategies, the rules of mounting, and the search."""
