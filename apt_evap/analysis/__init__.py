"""Analysis of maps and runs: profiles, zone lines, similarity, charge states, the apex, tracks of single ions."""
