"""Training of force networks: recipes, batches, the training loop, and training in several processes."""
