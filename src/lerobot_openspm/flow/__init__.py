"""The flow-matching model that fills the motion between key poses."""
