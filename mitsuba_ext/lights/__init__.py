"""Lights as what next event estimation chooses from: cells of emitters, tables over them."""
