"""Analysis of maps and runs: profiles, widths of zone lines, similarity, the apex, tracks of single ions."""
