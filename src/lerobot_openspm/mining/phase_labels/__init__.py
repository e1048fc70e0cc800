"""Phase labels: optional judges that say, beside motion and gripper, which phase ends at a key pose."""
