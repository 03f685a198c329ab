"""What knows nothing of scenes: arrays, files, errors, parameters, point sets, and sequences."""
