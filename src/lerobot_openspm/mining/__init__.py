"""From demonstrations to what is remembered and learned from them; `processor` is the front door."""
