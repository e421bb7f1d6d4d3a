"""Teams of filters: groups, communication, merges and their undoing."""
