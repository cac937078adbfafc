# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .emissions import Emissions as Emissions
from .emissions import Launches as Launches
from .emissions import TangentialLaunches as TangentialLaunches
from .energies import Thermal as Thermal
from .perturbations import IonRandom as IonRandom
from .perturbations import Mixture as Mixture
from .perturbations import Perturbation as Perturbation
from .post_ionisation import PostIonisation as PostIonisation
from .post_ionisation import charge_state_ratio as charge_state_ratio
from .post_ionisation import field_of_ratio as field_of_ratio
from .roll_probability import ChargeRatio as ChargeRatio
from .roll_probability import Migration as Migration
from .surface_frame import launch_tangentially as launch_tangentially
from .surface_frame import rollup_direction as rollup_direction
from .surface_frame import tangent_frame as tangent_frame
