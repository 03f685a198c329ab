"""Base classes of the plugins, and the table of what can fill their slots. They wire techniques and
estimators into Mitsuba."""
