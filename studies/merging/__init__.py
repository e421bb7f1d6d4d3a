"""Studies of alignment and of teams: right, missed and false merges, on pairs of maps and in whole episodes."""
