"""From demonstrations to what is remembered and learned from them; begin with `processor`."""
