"""The algorithms that there are: a further one is one file beside these, and one line here."""

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.bc import BC
from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQL, ETCQLPaper
from envtf_lit.agents.iql import IQL
from envtf_lit.agents.mobile import MOBILE
from envtf_lit.agents.mopo import MOPO
from envtf_lit.agents.rambo import RAMBO
from envtf_lit.agents.rebrac import ReBRAC
from envtf_lit.agents.sac import SAC
from envtf_lit.agents.td3_bc import TD3BC
from envtf_lit.agents.wbc import WBC

ALGORITHMS: dict[str, type[Agent]] = {
    "bc": BC,
    "wbc": WBC,
    "td3_bc": TD3BC,
    "rebrac": ReBRAC,
    "iql": IQL,
    "sac": SAC,
    "cql": CQL,
    "mopo": MOPO,
    "combo": COMBO,
    "rambo": RAMBO,
    "mobile": MOBILE,
    "et_cql_paper": ETCQLPaper,
    "et_cql": ETCQL,
}
