"""What may differ from one robot of a batch to the next: gains, parameters, the ground, the swings."""
