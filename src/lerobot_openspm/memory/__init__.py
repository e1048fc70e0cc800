"""The memory of key poses: entries, the bank that holds and saves them, instructions, retrieval."""
