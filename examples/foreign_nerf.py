"""Our consistency loss in a dynamic NeRF that knows nothing of us; runs in seconds.

Its warp leads from a moving scene back to a still one (D-NeRF and its followers). Colours alone
leave it free to fold; a second warp that leads forward again, and two calls of ours, bind it.
"""

import torch
from torch import Tensor, nn

from monopart.geometry import consistency_loss, round_trip


def mlp(inputs: int) -> nn.Sequential:
    """Numbers of a sample to three numbers."""
    first, second = nn.Linear(inputs, 64), nn.Linear(64, 64)
    return nn.Sequential(first, nn.SiLU(), second, nn.SiLU(), nn.Linear(64, 3))


def scene(points: Tensor, time: Tensor) -> Tensor:
    """True colours of a waving striped block: what the images of the foreign method show."""
    still = points[:, 1:2] - 0.2 * torch.sin(4 * time + 3 * points[:, :1])
    return torch.sin(still * torch.tensor([3.0, 6.0, 9.0])) / 2 + 0.5


def train(weight: float = 0.03, steps: int = 300) -> tuple[list[float], list[float]]:
    """Colour errors, and mean ways of points there and back in metres, of each step."""
    torch.manual_seed(0)
    backward, forward, color = mlp(4), mlp(4), mlp(3)  # the foreign method's, but for `forward`
    nets = nn.ModuleList([backward, forward, color])
    optimizer = torch.optim.Adam(nets.parameters(), lr=3e-3)
    errors, gaps = [], []
    for _ in range(steps):
        points, time = torch.rand(512, 3) - 0.5, torch.rand(512, 1)
        still = points + backward(torch.cat([points, time], -1))
        error = (color(still) - scene(points, time)).square().mean()
        gap = round_trip(
            points,
            lambda _, still=still: still,
            lambda p, time=time: p + forward(torch.cat([p, time], -1)),
        )
        optimizer.zero_grad()
        (error + weight * consistency_loss(gap, threshold=0.005)).backward()
        optimizer.step()
        errors.append(error.item())
        gaps.append(gap.mean().item())
    return errors, gaps


if __name__ == "__main__":
    for weight in (0.0, 0.03):
        errors, gaps = train(weight)
        print(f"weight {weight}: colour {errors[-1]:.4f}, there and back {1e3 * gaps[-1]:.0f} mm")
