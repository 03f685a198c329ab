"""What a shape subtends at a point: solid angles, and maps of the unit square to directions in
them. Nothing here knows a scene."""
