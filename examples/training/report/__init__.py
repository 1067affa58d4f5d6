"""What is said of many runs: statistics, tables and figures."""
