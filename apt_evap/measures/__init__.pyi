# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .clusters import ClusterSettings as ClusterSettings
from .clusters import choose_separation as choose_separation
from .clusters import label_clusters as label_clusters
from .clusters import nearest_neighbours as nearest_neighbours
from .composition_field import CompositionField as CompositionField
from .interface import interface_profile as interface_profile
from .interface import interfacial_excess as interfacial_excess
from .interface import ladder_diagram as ladder_diagram
from .interface import segregation_profile as segregation_profile
from .order import radial_distribution as radial_distribution
from .order import short_range_order as short_range_order
from .point_cloud import PointCloud as PointCloud
from .triangle_mesh import ConvexHull as ConvexHull
from .triangle_mesh import TriangleMesh as TriangleMesh
