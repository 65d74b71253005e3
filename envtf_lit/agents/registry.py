"""The algorithms that there are: a further one is one file beside these, and one line here."""

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.bc import BC
from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQL, ETCQLPaper

ALGORITHMS: dict[str, type[Agent]] = {
    "bc": BC,
    "cql": CQL,
    "combo": COMBO,
    "et_cql_paper": ETCQLPaper,
    "et_cql": ETCQL,
}
