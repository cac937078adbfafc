"""
Pairs of solutes, the analysis of visible.toml
==============================================

`apt-evap visible` calls the function of this file for every twin. It counts the pairs of copper ions that are closer
than 0.6 nm.
"""

from scipy.spatial import cKDTree


def pairs(positions, labels):
    """Number of pairs of Cu ions; labels are the elements in alphabetical order, 0 for Al and 1 for Cu."""
    tree = cKDTree(positions[labels == 1])
    return tree.count_neighbors(tree, 0.6)  # nm
