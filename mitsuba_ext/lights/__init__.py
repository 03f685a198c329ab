"""What next event estimation chooses from: parts of emitters (cells), and their first weights."""
