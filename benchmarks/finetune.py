"""What a model learned of one robot is worth on another: `python benchmarks/finetune.py [--out OUT.json]`.

`envtf_lit.studies.finetune` says what is trained. Printed are the best held-out errors and the updates after which the
fine-tuned model is as good as the one from scratch ever gets; what lies in the work folder is used again.
"""

import argparse
import json
import os
import sys
from dataclasses import fields
from pathlib import Path

from envtf_lit.studies.finetune import WORK, FinetuneOptions, run_finetune


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON")
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR")
    parser.add_argument("--base-updates", type=int, default=4_000)
    parser.add_argument("--updates", type=int, default=2_000, help="from scratch on the new robot")
    parser.add_argument("--tuned-updates", type=int, help="of the fine-tuned run; default: a quarter of them")
    parser.add_argument("--every", type=int, default=25, help="updates between two looks at the held-out error")
    parser.add_argument("--rows", type=int, default=20_000, help="of the new robot")
    parser.add_argument("--base-rows", type=int, default=100_000)
    parser.add_argument("--learning-rate", type=float, default=0.001, help="of the fine-tuned run; from scratch: 0.001")
    parser.add_argument("--freeze", default="[]", help="as --model.freeze")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    options = FinetuneOptions(**{field.name: getattr(given, field.name) for field in fields(FinetuneOptions)})
    result = run_finetune(given.out, work=given.work, options=options)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
