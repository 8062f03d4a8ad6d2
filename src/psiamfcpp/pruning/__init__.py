"""Filter pruning by the rank of feature maps, for any network: rank, plan, prune, refit."""

from psiamfcpp.pruning.groups import Group
from psiamfcpp.pruning.planning import Plan, plan
from psiamfcpp.pruning.ranking import rank
from psiamfcpp.pruning.refitting import refit
from psiamfcpp.pruning.surgery import prune
from psiamfcpp.pruning.table import RankTable

__all__ = ["Group", "Plan", "RankTable", "plan", "prune", "rank", "refit"]
