"""OpenSPM: manipulation from a readable memory of key poses."""
