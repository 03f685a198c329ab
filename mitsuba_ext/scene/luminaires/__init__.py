"""Area lights that are sampled by the solid angles of their shapes."""
