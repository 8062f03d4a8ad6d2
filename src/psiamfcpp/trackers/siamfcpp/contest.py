"""The check of a target that was re-acquired somewhere unexpected, against the place where it was expected."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

from psiamfcpp.trackers.siamfcpp.procedure import Target

# Number of looks at the expected place, and in how many in a row what is found there must lead; tried on rendered
# clips (`psiamfcpp demo`, seeds 0 to 14), where like cars pass while the target is under a bridge.
_LOOKS, _LEAD = 25, 5
# The place goes half-way to each find: where like things pass together, that keeps it with the one that came out
# nearest. On those clips a quarter or the whole way does as well; the whole lost UAVDT's S0601 to a car beside it.
_PULL = 0.5


@dataclass
class Contest:
    """What was re-acquired, against whatever appears where the target was expected."""

    place: Target
    """where to look: where the target would be, moving as when it was last seen, drawn to what is found there"""
    velocity: tuple[float, float]
    """of the target when it was last seen, pixels a frame"""
    looks_left: int = _LOOKS
    leads: list[float] = field(default_factory=list)

    def judge(self, found: Target, sure: bool, lead: float) -> bool:
        """Take one look at the place; whether what is found there has won.

        Args:
            found: what was found there, apart from what was re-acquired.
            sure: it could be re-acquired anywhere.
            lead: its score less the score of what was re-acquired.
        """
        self.looks_left -= 1
        t = self.place
        if sure:
            dx, dy = _PULL * (found.cx - t.cx), _PULL * (found.cy - t.cy)
            self.leads.append(lead)
        else:
            dx, dy = self.velocity
            self.leads.clear()
        self.place = dataclasses.replace(t, cx=t.cx + dx, cy=t.cy + dy)
        return len(self.leads) >= _LEAD and sum(self.leads[-_LEAD:]) > 0
