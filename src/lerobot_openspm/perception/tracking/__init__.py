"""Following objects through an episode, and noticing broken cameras."""
