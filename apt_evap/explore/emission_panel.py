"""Panel of the emission: its mechanism, and a slider for each parameter."""

from collections.abc import Callable
from typing import Any

from bokeh.models import RadioButtonGroup, Slider

from apt_evap.emission.perturbations import Perturbation
from apt_evap.explore.controls import CONTROLS, MECHANISMS, perturbation_of, values_of
from apt_evap.explore.explorer import Explorer
from apt_evap.explore.widgets import LEFT, group, request_maps_of, slider_with_number

_FURTHER = ("sharpness", "height", "others")  # sliders that few move


class EmissionPanel:
    """Widgets of the emission."""

    def __init__(self, explorer: Explorer, perturbation: Perturbation, request: Callable[[bool], None]) -> None:
        self._explorer, self._first, self._request = explorer, perturbation, request
        mechanism, values = values_of(perturbation)
        self.mechanism = RadioButtonGroup(
            labels=list(MECHANISMS), active=list(MECHANISMS).index(mechanism), width=LEFT - 10
        )
        permitted = {control.name: control for name in MECHANISMS for control in explorer.controls(name)}
        self._controls = [permitted[control.name] for control in CONTROLS if control.name in permitted]
        self.sliders = {
            control.name: Slider(
                title=control.title,
                start=control.low,
                end=max(control.high, values.get(control.name, 0.0)),
                step=control.step,
                value=values.get(control.name, control.value),
                format="0[.]000",
            )
            for control in self._controls
        }
        for slider in self.sliders.values():
            request_maps_of(slider, request)
        self.mechanism.on_change("active", lambda attr, old, new: self._mechanism_changed())
        self._show_sliders()
        first = [slider_with_number(slider) for name, slider in self.sliders.items() if name not in _FURTHER]
        further = [slider_with_number(slider) for name, slider in self.sliders.items() if name in _FURTHER]
        self.widgets: list[Any] = [self.mechanism, *first]
        self.widgets += [group("more", further, active=False)] if further else []

    @property
    def perturbation(self) -> Perturbation:
        """Emission of the current positions of the sliders."""
        defaults = {control.name: control.value for control in CONTROLS}
        values = defaults | {name: slider.value for name, slider in self.sliders.items()}
        return perturbation_of(self._mechanism, values)

    def reset(self) -> None:
        """Set the emission of the start."""
        mechanism, values = values_of(self._first)
        for control in self._controls:
            self.sliders[control.name].value = values.get(control.name, control.value)
        self.mechanism.active = list(MECHANISMS).index(mechanism)
        self._request(False)

    @property
    def _mechanism(self):
        return list(MECHANISMS)[self.mechanism.active]

    def _mechanism_changed(self):
        self._show_sliders()
        self._request(False)

    def _show_sliders(self):
        names = {control.name for control in self._explorer.controls(self._mechanism)}
        for name, slider in self.sliders.items():
            slider.visible = name in names
