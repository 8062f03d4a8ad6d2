"""From a score map to a calibrated confidence, and from confidences to the states tracking, unsure and lost."""

from __future__ import annotations

import math

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.contract import State

# A target is given up after this number of frames in a row that speak for its absence; one alone may be blur.
LOST_AFTER = 8


def confidence(peak: float, contrast: float, calibration: Calibration) -> float:
    """Estimated probability, 0..1, that the target is where the peak says.

    Args:
        peak: highest score, 0..1.
        contrast: what `procedure.contrast` gives.
        calibration: fitted weights.
    """
    logit = log_odds(min(max(peak, 1e-4), 1 - 1e-4))
    activation = calibration.bias + calibration.score_weight * logit + calibration.contrast_weight * contrast
    return 1 / (1 + math.exp(-min(max(activation, -50.0), 50.0)))


def log_odds(probability: float) -> float:
    """Return the logarithm of the odds for a probability, 0..1; those beyond 1e-6 and 1 - 1e-6 count as these."""
    probability = min(max(probability, 1e-6), 1 - 1e-6)
    return math.log(probability / (1 - probability))


class StateMachine:
    """The state of one target, frame by frame."""

    def __init__(self, calibration: Calibration):
        self._calibration = calibration
        self._doubtful = 0
        self.state: State = "tracking"

    def step(self, value: float, elsewhere: bool = False) -> State:
        """Take the confidence of one frame; the state that follows from it.

        Args:
            value: the confidence, 0..1.
            elsewhere: of a lost target, that what was found does not lie where it was last seen: it is more likely
                something else, and must be surer.
        """
        limits = self._calibration
        self._doubtful = self._doubtful + 1 if value < limits.lost_below else 0
        if self.state == "lost" and value < (limits.regain_above if elsewhere else limits.unsure_below):
            return self.state
        if self._doubtful >= LOST_AFTER:
            self.state = "lost"
        else:
            self.state = "unsure" if value < limits.unsure_below else "tracking"
        return self.state

    def regain(self) -> None:
        """Count the target as found, by evidence from elsewhere."""
        self._doubtful, self.state = 0, "tracking"
