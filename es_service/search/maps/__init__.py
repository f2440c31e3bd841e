"""The behaviour map (archive in pyribs, repertoire in QDax): cells of the descriptor space, each with its elite."""
