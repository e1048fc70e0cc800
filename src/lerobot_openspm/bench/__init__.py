"""What users measure on their own checkpoint, dataset and machine: ``openspm bench``."""
