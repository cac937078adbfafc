"""Settings of flights and responses for tests that compare maps of one simulation with each other."""

import apt_evap as ae

# both maps are made of the same flights: a tenth of a bin, 0.1 mm, will do; a fourth of the time of the defaults
ROUGH = {
    "flight_settings": ae.simulation.FlightSettings(opening_angle=0.6, tolerance=1e-2),
    "response_settings": ae.ResponseSettings(
        site=ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 6)), 8),
        rolled=ae.simulation.Design((2, 0), ((0.0, 1), (1.0, 6)), 20, place=True),
        bound=1.0,
    ),
}
