"""Objects known by the upright box around them."""
