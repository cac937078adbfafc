"""Controls of the voltage: the time to the next event, and the change of the rates from event to event."""


cdef extern from "elementary.h":
    double natural_logarithm(double) noexcept nogil
    double exponential_of(double) noexcept nogil


cdef class Control:
    """Interface of a control of the voltage; this one keeps the voltage, for laws without a time."""

    def __init__(self):
        self.voltage_factor = 1.0

    def before_relaxation(self, double log_rate, log_rate_at):
        """Voltage factor that includes `rise` (float).

        Parameters
        ----------
        log_rate : float
            Natural logarithm of the sum of the rates [1/s] after the last event, without `rise`.
        log_rate_at : callable
            Takes a voltage factor, returns this logarithm for the fields of the present surface.
        """
        return self.voltage_factor

    def after_relaxation(self, log_rate_at):
        """Voltage factor for the new surface (float), whose rates `log_rate_at` returns."""
        return self.voltage_factor

    cdef double wait(self, double u, double log_rate) noexcept nogil:
        # Time to the next event [s], from a random number u in (0, 1) and the natural logarithm of the sum of the rates
        # [1/s] without `rise`; `rise` is then the value at the event.
        return 0.0

    cdef void evaporated(self) noexcept nogil:
        # To be called after `wait`, when `rise` at the event has been recorded.
        pass


cdef class SteadyRate(Control):
    """Control that keeps the mean rate constant.

    While no event happens, the logarithm of all rates rises by 1 / memory in the mean time between events. Every event
    lowers it by 1 / memory.

    Parameters
    ----------
    rate : float
        Requested sum of the rates [1/s].
    memory : float
        Number of events over which the rate is averaged.
    """

    def __init__(self, double rate, double memory):
        Control.__init__(self)
        self.rate, self.memory = rate, memory

    cdef double wait(self, double u, double log_rate) noexcept nogil:
        # K exp(rise + t rate / memory) integrates to -ln(u)
        cdef double speed = self.rate / self.memory, excess, time
        excess = natural_logarithm(-natural_logarithm(u) * speed) - log_rate - self.rise
        if excess > 40.0:               # log(1 + exp(x)) = x to the last bit
            time = excess
        elif excess < -20.0:            # exp(x) (1 - exp(x) / 2), to the last bit
            time = exponential_of(excess)
            time -= 0.5 * time * time
        else:
            time = natural_logarithm(1.0 + exponential_of(excess))
        self.rise += time
        return time / speed

    cdef void evaporated(self) noexcept nogil:
        self.rise -= 1.0 / self.memory
