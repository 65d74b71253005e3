"""What an executed notebook says."""

from pathlib import Path

import nbformat


def said(notebook: Path) -> str:
    """All sentences that its code printed, of which none may be a complaint."""
    cells = nbformat.read(notebook, 4).cells
    outputs = [output for cell in cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "stream" and output.name == "stderr"]
    return " ".join(output.data["text/markdown"] for output in outputs if "text/markdown" in output.get("data", {}))
