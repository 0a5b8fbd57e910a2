"""LPIPS-VGG by the package `lpips` itself; run as a script it rewrites the JSON file beside it.

    pip install --no-deps lpips==0.1.4 torchvision tqdm
    python tests/toolkit/golden_lpips_package.py

The package's own heads, version 0.1, are taken as it ships them. The backbone that it would
download is the VGG16 that the toolkit found on this machine; tests check it by other figures.
"""

import json
from pathlib import Path

from golden_lpips import images

GOLDEN = Path(__file__).with_suffix(".json")
VGG16_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def main():
    """Write the figures of all golden images, fed [-1, 1] and [0, 1], and the sums of the heads."""
    import lpips
    import torch

    from monopart.toolkit.lpips_weights import find_lpips_weights

    weights = find_lpips_weights(required=True)
    net = lpips.LPIPS(net="vgg", pnet_rand=True, version="0.1", verbose=False).double()
    slices = dict(net.net.named_parameters())
    for i, layer in enumerate(VGG16_CONVOLUTIONS):
        for kind in ("weight", "bias"):
            (name,) = (n for n in slices if n.endswith(f".{layer}.{kind}"))
            slices[name].data.copy_(weights[f"conv.{i}.{kind}"])
    figures = {"heads": [lin.model[1].weight.sum().item() for lin in net.lins]}
    with torch.no_grad():
        for name, pair in images().items():
            a, b = (torch.from_numpy(x).permute(2, 0, 1)[None].double() for x in pair)
            figures[name] = {
                "[-1,1]": float(net(a, b, normalize=True)),
                "[0,1]": float(net(a, b)),
            }
    GOLDEN.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
