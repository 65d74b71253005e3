"""Sixty steps of policy.onnx in world_model.onnx, from the mean state of its data: no PyTorch, no envtf_lit."""

import numpy as np
import onnxruntime

policy, model = (onnxruntime.InferenceSession(f"{name}.onnx") for name in ("policy", "world_model"))
types = {"tensor(float)": np.float32, "tensor(int64)": np.int64}
state = {i.name: np.zeros([1, *i.shape[1:]], types[i.type]) for i in model.get_inputs()}
first = model.get_modelmeta().custom_metadata_map["observation_mean"]
state["observation"][0] = np.fromstring(first.strip("[]"), sep=",")
outputs = [output.name for output in model.get_outputs()]
generator = np.random.default_rng(0)
for step in range(60):
    noise = np.zeros_like(state["action"])  # of the policy: none
    (state["action"],) = policy.run(["action"], {"observation": state["observation"], "noise": noise})
    state["noise"] = generator.standard_normal(state["noise"].shape, np.float32)
    found = dict(zip(outputs, model.run(None, state), strict=True))
    print(step, found["reward"].item(), found["uncertainty"].item())
    state |= {name.removeprefix("next_"): found[name] for name in outputs if name.startswith("next_")}
