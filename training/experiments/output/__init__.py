"""What experiments show: console and its progress displays, messages, tables, plots and charts."""
