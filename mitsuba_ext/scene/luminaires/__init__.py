"""Area lights that are sampled by the solid angle that their shapes subtend."""
