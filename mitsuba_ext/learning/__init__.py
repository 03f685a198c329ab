"""What is learned from samples: tables that a decision reads, filled between the stages."""
