"""Path guiding in primary sample space."""
