"""What a render learns, and whether it pays: learners, predictions, files of what was learned."""
