"""Weighted point sets for connections, and for the numbers of camera rays."""
