"""Shows renders while they run: in the viewer tev, and on a local web page."""
