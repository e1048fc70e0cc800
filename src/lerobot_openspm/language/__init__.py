"""English in, subtasks and similarities out. No other room knows a word of English."""
