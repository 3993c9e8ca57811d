"""What a hidden effect is, and what counts as its name."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.campaign import Campaign
from tests.discovery.generator.machine import lever
from tests.discovery.generator.world import World

Floats = NDArray[np.float64]
Shape = Callable[[World, np.random.Generator], Floats]


@dataclass(frozen=True)
class Same:
    """Another name for the same mathematics, decided before any result was seen.

    Attributes:
        effect: name in the program's catalogue.
        why: the same formula, or one that holds it.
        component: of it, with the letters of `Truth.component`; empty: that of the truth.
        sensors: it counts with these only; empty: with any.
    """

    effect: str
    why: str
    component: str = ""
    sensors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Truth:
    """One hidden effect.

    Attributes:
        name: in the program's catalogue; for one outside it, a name of its own.
        kind: of the campaign that shows it.
        component: that it feeds; `{a}` stands for the line's axis, `{c}` for what the instrument reads across.
        shape: the component error in any unit, (n,).
        replaces: keys of `base.known` that it takes the place of.
        same: other names that are right.
        variables: channels that it truly depends on, `{a}` for the line's axis; for those outside the catalogue.
        axes: lines that it may be on.
    """

    name: str
    kind: str
    component: str
    shape: Shape
    replaces: tuple[str, ...] = ()
    same: tuple[Same, ...] = ()
    variables: tuple[str, ...] = ()
    axes: str = "XYZ"

    def component_on(self, campaign: Campaign) -> str:
        """The component on a line."""
        return filled(self.component, campaign)

    def contribution(self, world: World, rng: np.random.Generator) -> Floats:
        """What it adds to every column, in any unit, (columns, n)."""
        return world.readings(self.component_on(world.campaign), self.shape(world, rng))

    def accepts(self, effect: str, component: str, sensor: str, campaign: Campaign) -> bool:
        """Whether an answer names it: its effect or another name for the same, on a component that reads the same."""
        names = [
            (self.name, self.component, ()),
            *((s.effect, s.component or self.component, s.sensors) for s in self.same),
        ]
        return any(
            effect == name
            and same_component(campaign, component, filled(where, campaign))
            and (not sensors or sensor in sensors)
            for name, where, sensors in names
        )


def filled(text: str, campaign: Campaign) -> str:
    """A name with the letters of a campaign."""
    other = next(a for a in "XYZ" if a != campaign.axis)
    return text.format(a=campaign.axis, c=campaign.across, low=campaign.axis.lower(), other=other.lower())


def same_component(campaign: Campaign, one: str, two: str) -> bool:
    """Whether no reading of a campaign can tell two components: their lever arms are proportional at all poses."""
    if one == two:
        return True
    a, b = (np.concatenate([lever(c, campaign.pose_mm, col) for col in campaign.columns]) for c in (one, two))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return size > 0.0 and abs(float(a @ b)) > (1.0 - 1e-9) * size
