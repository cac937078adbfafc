"""Registration of two detector maps: rotation, scale, shift and mirror."""
