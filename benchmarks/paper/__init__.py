"""The paper's Tables 2 to 4 and Figures 5, 8 to 11 and 13, made again."""
