"""What a user names, read and checked: scene files, integrators with parameters, variants."""
