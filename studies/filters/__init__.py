"""Studies of one robot's filter: its accuracy, where that is lost, faults that it notices, and other estimators."""
