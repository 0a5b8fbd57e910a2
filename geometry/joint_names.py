"""Names of the joints of SMPL bodies; free of torch, for tools that only read files."""

_SMPL_JOINTS = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar"),
    *("right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    *("left_wrist", "right_wrist", "left_hand", "right_hand"),
)
_NUM_SHARED_JOINTS = 22  # SMPL, SMPL-H and SMPL-X agree up to the wrists


def joint_names(num_joints: int) -> tuple[str, ...]:
    """Names of the joints of a body, by their number.

    Args:
        num_joints: 24 (SMPL) names all, more (SMPL-H, SMPL-X) the first 22, fewer none.

    Returns:
        One name per joint, `joint_N` where none is known.

    >>> joint_names(52)[20:23]
    ('left_wrist', 'right_wrist', 'joint_22')
    """
    if num_joints == len(_SMPL_JOINTS):
        return _SMPL_JOINTS
    shared = _SMPL_JOINTS[:_NUM_SHARED_JOINTS] if num_joints > len(_SMPL_JOINTS) else ()
    return shared + tuple(f"joint_{j}" for j in range(len(shared), num_joints))
