"""The behaviour map: cells of the descriptor space, and in each the fittest centre that was ever evaluated there."""
