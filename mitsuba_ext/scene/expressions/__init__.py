"""Light path expressions: regular expressions over the events of a path."""
