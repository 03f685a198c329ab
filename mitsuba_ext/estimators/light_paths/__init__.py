"""Light paths: emission, the light walk with its stored vertices, and connections to camera paths
and to the sensor."""
