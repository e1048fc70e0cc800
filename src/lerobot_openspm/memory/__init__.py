"""The memory of key poses: entries, retrieval, one reader and one writer."""
