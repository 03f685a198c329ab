"""Files of arrays: nothing of them is used before its type, its shape and its range are checked."""
