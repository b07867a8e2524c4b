"""What several programs of the lab share: lists of scenes, comparison of pictures, clocks, results,
tables."""
