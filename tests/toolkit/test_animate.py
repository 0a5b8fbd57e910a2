"""The turntable: cameras on a level circle that look at the person."""

import numpy as np
import pytest
import torch

from monopart.geometry.errors import InputError
from monopart.toolkit.animate import as_uint8, turntable_views, world_up
from monopart.toolkit.render import render_view, render_views
from monopart.toolkit.runs import open_run


@pytest.fixture(scope="module")
def avatar(trained_run):
    return open_run(trained_run)


def test_cameras_stand_on_a_level_circle(avatar):
    views = turntable_views(avatar, 6, frame=1)
    centers = torch.stack([v.camera.center for v in views])
    up = world_up(avatar.record.cameras)
    assert torch.equal(up, torch.tensor([0.0, 0.0, 1.0])), "the miniature stands along z"
    heights = centers @ up
    assert float(heights.max() - heights.min()) < 1e-4
    flat = centers - centers.mean(0)
    radius = flat.norm(dim=-1)
    assert float(radius.std()) < 1e-4 < float(radius.min())
    turn = torch.stack([(flat[i] * flat[(i + 1) % 6]).sum() for i in range(6)])
    assert torch.allclose(turn, radius**2 * 0.5, atol=1e-3), "60 degrees between neighbours"
    for view in views:
        assert view.frame == 1 and view.pose is avatar.record.poses[1]
        verts = avatar.record.body(view.pose).verts_world
        assert float(view.camera.visible(verts).float().mean()) > 0.95


def test_size_and_frame(avatar):
    views = turntable_views(avatar, 2, size=24)
    assert tuple(views[0].camera.size) == (24, 24) and views[0].frame == 0
    assert tuple(turntable_views(avatar, 1)[0].camera.size) == (48, 48)
    assert turntable_views(avatar, 1, frame=3)[0].frame == 3, "a held-out pose is a pose"
    with pytest.raises(InputError, match="--frame 9: expected a frame with a body pose, 0 to 3"):
        turntable_views(avatar, 1, frame=9)


def test_views_of_one_pose_share_its_body(avatar, monkeypatch):
    views = [*turntable_views(avatar, 2, size=24), *turntable_views(avatar, 1, frame=1, size=24)]
    alone = [render_view(avatar, v).color for v in views]
    posed, whole = [], type(avatar).pose_scene

    def count(self, pose):
        posed.append(pose)
        return whole(self, pose)

    monkeypatch.setattr(type(avatar), "pose_scene", count)
    done = []
    together = render_views(avatar, views, lambda i, n: done.append((i, n)))
    assert len(posed) == 2 and done == [(1, 3), (2, 3), (3, 3)]
    assert all(torch.equal(a, b.color) for a, b in zip(alone, together, strict=True))


def test_bytes_are_rounded():
    image = torch.tensor([[[0.0, 0.5, 1.0]]])
    assert as_uint8(image).tolist() == [[[0, 128, 255]]] and as_uint8(image).dtype == np.uint8
