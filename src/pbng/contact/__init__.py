"""Contact: trees, closest points, and the pairs that are found."""
