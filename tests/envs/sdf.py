"""Files of Gazebo to read."""

import gzip
import warnings

from mpfa_envs.worlds.gazebo import load_gazebo_world

CYLINDER = "<cylinder><radius>0.075</radius><length>1</length></cylinder>"


def model(geometry, pose="0 0 0 0 0 0", *, static="<static>1</static>", link="", name="m"):
    """A model of one link and one collision; the visual is larger and must not count."""
    seen = "<visual><geometry><box><size>9 9 9</size></box></geometry></visual>"
    collision = f"<collision name='c'>{link}<geometry>{geometry}</geometry></collision>"
    link = f"<link name='l'>{seen}{collision}</link>"
    return f"<model name='{name}'>{static}<pose frame=''>{pose}</pose>\n{link}</model>\n"


def write(folder, content, head="", name="room.world"):
    start = f"<?xml version='1.0'?>\n{head}<sdf version='1.6'>\n<world name='w'>\n"
    text = f"{start}{content}</world></sdf>"
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def box(x, y, z, sides, name="m"):
    """A static box in the middle of its pose."""
    return model(f"<box><size>{sides}</size></box>", f"{x} {y} {z} 0 0 0", name=name)


def walls(bottom=0.0, *, height=1.0, half=5.0):
    """Four walls of 0.2 m around a room of 10 x 10 m, or another."""
    z, long = bottom + height / 2, f"{2 * half}"
    return "".join(
        box(*place, sides)
        for place, sides in (
            ((0, half, z), f"{long} 0.2 {height}"),
            ((0, -half, z), f"{long} 0.2 {height}"),
            ((half, 0, z), f"0.2 {long} {height}"),
            ((-half, 0, z), f"0.2 {long} {height}"),
        )
    )


def quietly(path, **arguments):
    """A world, and the only warning or an empty text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        world = load_gazebo_world(path, **arguments)
    return world, "".join(str(each.message) for each in caught)
