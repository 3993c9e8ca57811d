"""What a true shape may look at: everything that happens at the instants of the readings, as it truly is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.campaign import Campaign
from tests.discovery.generator.machine import PITCH_MM, TRAVEL_MM, lever
from tests.discovery.generator.thermal import Weather, lag

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class World:
    """A campaign on a day.

    Attributes:
        campaign: what is done.
        weather: temperatures and spindle speed.
    """

    campaign: Campaign
    weather: Weather

    @property
    def q(self) -> Floats:
        """Position along the line, mm."""
        return self.campaign.pose_mm[self.campaign.axis]

    @property
    def u(self) -> Floats:
        """The same from -1 to 1 over the travel."""
        return self.scaled(self.campaign.axis)

    @property
    def pitch_mm(self) -> float:
        """Pitch of the line's screw."""
        return PITCH_MM[self.campaign.axis]

    @property
    def d(self) -> Floats:
        """Direction along the line."""
        return self.campaign.direction[self.campaign.axis]

    @property
    def feed_m_min(self) -> Floats:
        """Feed without sign."""
        return self.campaign.feed_mm_min * 1e-3

    @property
    def since_mm(self) -> Floats:
        """Distance since the last reversal of the line."""
        return self.campaign.since_mm[self.campaign.axis]

    @property
    def acceleration_m_s2(self) -> Floats:
        """Along the line."""
        return self.campaign.acceleration_mm_s2[self.campaign.axis] * 1e-3

    @property
    def load(self) -> Floats:
        """Work piece, in units of 100 kg."""
        return self.campaign.load_kg * 1e-2

    @property
    def hours(self) -> Floats:
        """Since the start."""
        return self.campaign.time_s / 3600.0

    def scaled(self, axis: str) -> Floats:
        """A position from -1 to 1 over its travel."""
        low, high = TRAVEL_MM[axis]
        return (self.campaign.pose_mm[axis] - 0.5 * (low + high)) * (2.0 / (high - low))

    def other(self, which: int) -> str:
        """One of the two axes that do not travel along the line."""
        return [a for a in "XYZ" if a != self.campaign.axis][which]

    def rise(self, body: str) -> Floats:
        """True temperature above 20 °C."""
        return self.weather.at(self.weather.body[body], self.campaign.time_s) - 20.0

    def shown(self, sensor: str) -> Floats:
        """What an ideal sensor shows above 20 °C."""
        return self.weather.at(self.weather.sensor[sensor], self.campaign.time_s) - 20.0

    def rise_lagged(self, body: str, *minutes: float) -> Floats:
        """True temperature above 20 °C through lags one after the other."""
        values = self.weather.body[body] - 20.0
        for m in minutes:
            values = lag(values, 60.0 * m)
        return self.weather.at(values, self.campaign.time_s)

    def heat(self, power: float, *minutes: float) -> Floats:
        """Spindle speed in 10 000/min to a power, through lags."""
        values = (self.weather.rpm / 10000.0) ** power
        for m in minutes:
            values = lag(values, 60.0 * m)
        return self.weather.at(values, self.campaign.time_s)

    @property
    def krpm(self) -> Floats:
        """Spindle speed now, 1000/min."""
        # The speed of the grid as it is, not a mean over a change.
        index = np.searchsorted(self.weather.time_s, self.campaign.time_s, side="right") - 1
        return self.weather.rpm[index] * 1e-3

    def readings(self, component: str, error: Floats) -> Floats:
        """What a component error adds to every column, (columns, n)."""
        c = self.campaign
        return np.stack([lever(component, c.pose_mm, column) * error for column in c.columns])
