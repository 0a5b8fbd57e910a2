"""Weights of a run: safetensors, written whole or not at all, read back strictly."""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from monopart.geometry.errors import InputError

from .atomic import write_bytes

WEIGHTS = "model.safetensors"


def save_weights(model: torch.nn.Module, run: Path) -> None:
    """Write the state of a model into a run folder."""
    state = {name: value.contiguous() for name, value in model.state_dict().items()}
    write_bytes(run / WEIGHTS, save(state))


def load_weights(model: torch.nn.Module, run: Path) -> None:
    """Read the state of a model from a run folder, in place.

    Raises:
        InputError: the file is absent, broken or of another model.
    """
    path = run / WEIGHTS
    try:
        state = load(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: expected trained weights, found no file; train first") from None
    except SafetensorError as error:
        raise InputError(
            f"{path}: expected safetensors, found a broken file ({error}); train again"
        ) from None
    own = model.state_dict()
    wrong = sorted(state.keys() ^ own.keys())
    wrong += [n for n in state.keys() & own.keys() if state[n].shape != own[n].shape]
    if wrong:
        raise InputError(
            f"{path}: expected the tensors of this configuration, found a difference in "
            f"{wrong[0]}; use the config.json and the capture of this run"
        )
    model.load_state_dict(state)
