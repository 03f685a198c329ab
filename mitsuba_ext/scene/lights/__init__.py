"""Parts of emitters (cells) for next event estimation, and their weights before learning."""
