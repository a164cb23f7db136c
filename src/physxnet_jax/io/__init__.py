"""Readers and writers of mesh files; optional libraries are imported inside functions."""

from ._animated_mesh import (
    AnimatedMesh as AnimatedMesh,
    Look as Look,
    Skinning as Skinning,
    StaticMesh as StaticMesh,
    smooth_normals as smooth_normals,
)
from ._frame_rate import nominal_rate as nominal_rate
from ._gltf_file import (
    GLTF_FORMATS as GLTF_FORMATS,
    GltfFile as GltfFile,
    nearest_turns as nearest_turns,
)
from ._gltf_mesh import (
    read_gltf_meshes as read_gltf_meshes,
    read_gltf_still as read_gltf_still,
    read_posed_gltf as read_posed_gltf,
)
from ._gltf_rig import write_dressed_rig as write_dressed_rig
from ._gltf_skin import rest_matrices as rest_matrices
from ._mdd import read_mdd as read_mdd, write_mdd as write_mdd
from ._mesh_file import (
    GARMENT_FORMATS as GARMENT_FORMATS,
    mesh_name as mesh_name,
    read_mesh as read_mesh,
    split_part as split_part,
)
from ._obj import read_obj as read_obj, write_materials as write_materials, write_obj as write_obj
from ._pc2 import read_pc2 as read_pc2, write_pc2 as write_pc2
from ._source_mesh import SourceMesh as SourceMesh, joined as joined, named as named
from ._usd_mesh import read_usd_meshes as read_usd_meshes
from ._write import EXTENSIONS as EXTENSIONS, check_output as check_output, write_clip as write_clip
