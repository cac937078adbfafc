"""Poles and zone lines on the detector, and the orientation of a specimen from them."""
