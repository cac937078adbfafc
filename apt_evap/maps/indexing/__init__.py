"""Which crystal direction is where on a map: master patterns, the search, its refinement."""
