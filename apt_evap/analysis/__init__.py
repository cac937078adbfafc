"""What maps and runs say: profiles, widths of zone lines, similarity, the apex, tracks of single ions."""
