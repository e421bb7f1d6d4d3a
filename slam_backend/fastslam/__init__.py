"""FastSLAM for one robot or for several that share a map: the filter, its particles, its options and reports."""
