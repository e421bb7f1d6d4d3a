"""Teams of filters: groups, communication, merges and rollback."""
