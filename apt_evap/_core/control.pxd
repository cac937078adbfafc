"""Interface of a control of the voltage: all that the events need of it, for a law with rates.

The charges are those at the applied voltage. The law sees their fields times `voltage_factor`, which changes only in
relaxations. From one relaxation to the next, the control changes all rates by the same factor exp(`rise`), which does
not change the probabilities of the next atom.

The order of the calls is: `before_relaxation`, except before the first one and if a state is restored; then the rule
solves the charges; `after_relaxation`; then for every event that is drawn from the rates `wait` and `evaporated`. An
atom that leaves because it is detached needs no call. The first two are methods of Python. They get a function
``log_rate_at(voltage_factor)``, the natural logarithm of the sum of all rates [1/s] of the present surface, and return
the new voltage factor. It is set after the charges are solved, so that an interrupted relaxation changes nothing.
"""


cdef class Control:
    cdef public double voltage_factor   # voltage that the law sees over that of the charges
    cdef readonly double rise           # natural logarithm of the factor of all rates; 0 after a relaxation

    cdef double wait(self, double u, double log_rate) noexcept nogil
    cdef void evaporated(self) noexcept nogil


cdef class SteadyRate(Control):
    cdef readonly double rate           # wanted sum of rates [1/s]
    cdef readonly double memory         # number of events over which the control averages
