"""PLY files of any layout, as plyfile writes them."""

import numpy as np
from plyfile import PlyData, PlyElement

from pointsplat_ns.scene.ply import column_names, row_table


def columns_of(scene):
    """The vertex properties of a 3DGS PLY: name to an array (N,)."""
    return dict(
        zip(column_names(3 * scene.features_rest.shape[1]), row_table(scene).T, strict=True)
    )


def write_columns(path, columns, text=False, order="<", comments=(), before=()):
    """A PLY of columns: name to an array (N,) of the type that is written."""
    vertex = PlyElement.describe(
        np.array(np.rec.fromarrays([*columns.values()], names=[*columns])), "vertex"
    )
    PlyData([*before, vertex], text=text, byte_order=order, comments=list(comments)).write(
        str(path)
    )
    return path
