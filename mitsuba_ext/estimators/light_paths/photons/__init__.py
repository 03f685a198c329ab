"""Photon maps, on surfaces and in media, and the camera paths that end at them."""
