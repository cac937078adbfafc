"""Robin's rule, and the scalar product of the charging rules."""

from apt_evap._core.index cimport Index
from apt_evap._core.interactions cimport InteractionLists
from apt_evap._core.octree cimport Octree
from apt_evap._core.rule cimport FieldRule, Patch


cdef double dot(const double[::1] first, const double[::1] second) noexcept nogil


cdef class Robin(FieldRule):
    cdef readonly double tolerance
    cdef readonly int window
    cdef readonly object point          # (1, 3) the point inside with the given potential [nm]
    cdef double[3] inner                # the same at the last relaxation
    cdef double potential               # of the specimen at the last relaxation [e/nm]
    cdef double clearance               # initial distance of this point from the surface [nm]
    cdef double far_scale               # factor of the charges far from the holes since the whole surface was solved
    cdef float[::1] matrix, columns
    cdef float[::1] cubes               # 1/r^3 between the slots of a patch, by rows [1/nm^3]

    cdef sample_fields(self, const double[:, ::1] normals, InteractionLists lists)
    cdef scale_others(self, Octree tree, InteractionLists lists, ratios)
    cdef double along(self, const double[:, ::1] normals, Index i) noexcept nogil
    cdef normal_field(self, Octree tree, const double[:, ::1] normals)
    cdef double inside(self, double x, double y, double z, double charge) noexcept nogil
    cdef int grow(self, Index stride) except -1 nogil
    cdef int patch_charges(self, Octree tree, double[:, ::1] normals, Patch* patch) except -1 nogil
