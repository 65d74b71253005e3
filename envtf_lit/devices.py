"""Where tensors live, and which precision of matrix products pays there."""

from typing import Literal

import torch

from envtf_lit.options.schema import Precision

BF16 = "avx512_bf16", "amx_bf16", "bf16", "sve_bf16"  # capabilities of a CPU; the last two are Arm's


def pick_device() -> torch.device:
    """The accelerator if there is one, else the CPU."""
    if torch.accelerator.is_available():
        accelerator = torch.accelerator.current_accelerator()
        assert accelerator is not None
        return accelerator
    return torch.device("cpu")


def multiplies_bf16(device: torch.device) -> bool:
    """Whether the device is known to have instructions for matrix products in bf16; others may emulate them, slowly."""
    if device.type == "cpu":
        able = torch.cpu.get_capabilities()
        return any(able.get(name, False) for name in BF16)
    supported = getattr(torch.get_device_module(device), "is_bf16_supported", None)
    return supported is not None and supported(including_emulation=False)


def resolved(precision: Precision, device: torch.device | None = None) -> Literal["fp32", "bf16"]:
    """What a precision is on a device, by default that of `pick_device`."""
    if precision != "auto":
        return precision
    return "bf16" if multiplies_bf16(device or pick_device()) else "fp32"


def autocast(device: torch.device, precision: Precision) -> torch.autocast:
    """bf16 matrix products where the parameters ask for them."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=resolved(precision, device) == "bf16")
