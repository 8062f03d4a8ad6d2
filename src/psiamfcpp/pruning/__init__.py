"""Filter pruning by the rank of feature maps, or by any other criterion, for any network: rank, plan, prune, refit."""

from psiamfcpp.pruning.criteria import CRITERIA, Context, Criterion, find_criterion, gradients_of, score_table, scores
from psiamfcpp.pruning.groups import Group, find_groups
from psiamfcpp.pruning.planning import Plan, plan, plan_for_budget
from psiamfcpp.pruning.ranking import rank
from psiamfcpp.pruning.refitting import refit
from psiamfcpp.pruning.surgery import prune
from psiamfcpp.pruning.table import RankTable

__all__ = [
    "CRITERIA",
    "Context",
    "Criterion",
    "Group",
    "Plan",
    "RankTable",
    "find_criterion",
    "find_groups",
    "gradients_of",
    "plan",
    "plan_for_budget",
    "prune",
    "rank",
    "refit",
    "score_table",
    "scores",
]
