"""The same U-Net in PyTorch, eager and compiled; run by `experiments/bench_peers.py`.

It needs torch and numpy alone, and a Python that has them: it never imports this project.

Command: TORCH_PYTHON experiments/peers/torch_network.py INPUT.npz OUTPUT.npz
"""

import json
import statistics
import sys
import time

import numpy as np
import torch
from torch import nn


class Down(nn.Module):
    """4x4 convolution of stride 2, batch norm, ReLU."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs, eps=1e-5)

    def forward(self, x):
        """Features of half the size."""
        return torch.relu(self.norm(self.conv(x)))


class Up(nn.Module):
    """4x4 transposed convolution of stride 2, and batch norm but for the last."""

    def __init__(self, inputs, outputs, last):
        super().__init__()
        self.conv = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=last)
        self.norm = nn.Identity() if last else nn.BatchNorm2d(outputs, eps=1e-5)

    def forward(self, x):
        """Features of twice the size."""
        return self.norm(self.conv(x))


class Generator(nn.Module):
    """One encoder, a decoder for each garment."""

    def __init__(self, channels, width, templates):
        super().__init__()
        deep = [width * 2**k for k in range(4)]
        self.templates = templates
        self.encoder = nn.ModuleList(
            [Down(a, b) for a, b in zip([channels, *deep], deep, strict=False)]
        )
        self.decoders = nn.ModuleDict(
            {
                t: nn.ModuleList(
                    [
                        Up(deep[3], deep[2], False),
                        Up(2 * deep[2], deep[1], False),
                        Up(2 * deep[1], deep[0], False),
                        Up(2 * deep[0], 3, True),
                    ]
                )
                for t in templates
            }
        )

    def forward(self, x):
        """Maps of all templates, side by side as channels."""
        features = []
        for layer in self.encoder:
            x = layer(x)
            features.append(x)
        out = []
        for t in self.templates:
            y = features[-1]
            for k, layer in enumerate(self.decoders[t]):
                y = layer(y)
                if k < 3:
                    y = torch.cat([torch.relu(y), features[2 - k]], dim=1)
            out.append(y)
        return torch.cat(out, dim=1)


def load(network, data):
    """Parameters from names like encoder.0.conv and decoders.top.1.norm.mean."""

    def tensor(name):
        return torch.from_numpy(np.ascontiguousarray(data[name]))

    def norm(layer, name):
        layer.weight.data = tensor(f"{name}.scale")
        layer.bias.data = tensor(f"{name}.bias")
        layer.running_mean.data = tensor(f"{name}.mean")
        layer.running_var.data = tensor(f"{name}.var")

    for k, layer in enumerate(network.encoder):
        layer.conv.weight.data = tensor(f"encoder.{k}.conv").permute(3, 2, 0, 1).contiguous()
        norm(layer.norm, f"encoder.{k}.norm")
    for t, layers in network.decoders.items():
        for k, layer in enumerate(layers):
            name = f"decoders.{t}.{k}"
            layer.conv.weight.data = tensor(f"{name}.conv").permute(2, 3, 0, 1).contiguous()
            if layer.conv.bias is not None:
                layer.conv.bias.data = tensor(f"{name}.bias")
            else:
                norm(layer.norm, f"{name}.norm")


def main():
    source, target = sys.argv[1:3]
    data = np.load(source)
    told = json.loads(str(data["told"]))
    torch.set_num_threads(told["threads"])
    network = Generator(told["channels"], told["width"], told["templates"]).eval()
    load(network, data)
    forms = {"torch eager": network, "torch compiled": torch.compile(network, dynamic=False)}
    rows, answers = [], {}
    with torch.inference_mode():
        for batch in told["batches"]:
            x = torch.from_numpy(data["maps"][:batch]).permute(0, 3, 1, 2).contiguous()
            for name, form in forms.items():
                began = time.perf_counter()
                y = form(x)
                cold = time.perf_counter() - began
                answers[f"{name} {batch}"] = y.permute(0, 2, 3, 1).contiguous().numpy()
                laps, began = [], time.perf_counter()
                while len(laps) < 20 or time.perf_counter() - began < told["seconds"]:
                    start = time.perf_counter()
                    form(x)
                    laps.append(1e3 * (time.perf_counter() - start))
                ms = statistics.median(laps) / batch
                rows.append({"form": name, "batch": batch, "ms_per_frame": ms, "cold_s": cold})
    version = f"torch {torch.__version__}, {torch.get_num_threads()} threads"
    np.savez(target, rows=json.dumps(rows), version=version, **answers)


if __name__ == "__main__":
    main()
