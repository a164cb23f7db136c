"""Triangle meshes and geometric queries, independent of bodies and garments."""

from ._barycentric import interpolate as interpolate
from ._bridge import bridge_hollows as bridge_hollows
from ._candidates import nearby_faces as nearby_faces, spread_points as spread_points
from ._closest import (
    closest_among as closest_among,
    closest_barycentric as closest_barycentric,
    closest_on_host as closest_on_host,
    closest_points as closest_points,
    fast_argmin as fast_argmin,
    nearest_distinct as nearest_distinct,
    nearest_index as nearest_index,
    nearest_indices as nearest_indices,
    signed_distance as signed_distance,
)
from ._coarse import (
    FINE_MESH as FINE_MESH,
    NUM_SITES as NUM_SITES,
    coarse_mesh as coarse_mesh,
    linear_weights as linear_weights,
)
from ._edge_constraints import (
    EdgeConstraints as EdgeConstraints,
    limit_strain as limit_strain,
    make_edge_constraints as make_edge_constraints,
)
from ._frames import map_frames as map_frames
from ._intersect import self_intersections as self_intersections
from ._laplacian import (
    cotangent_laplacian as cotangent_laplacian,
    mesh_laplacian as mesh_laplacian,
)
from ._materialize import materialize as materialize
from ._mesh import TriMesh as TriMesh, make_mesh as make_mesh
from ._normals import vertex_normals as vertex_normals
from ._padding import (
    ROW_MULTIPLE as ROW_MULTIPLE,
    pad_rows as pad_rows,
    padded_rows as padded_rows,
)
from ._patches import patch_shares as patch_shares
from ._polygons import (
    Material as Material,
    Polygons as Polygons,
    Texture as Texture,
    joined_polygons as joined_polygons,
    make_material as make_material,
    make_texture as make_texture,
)
from ._raycast import cast_rays as cast_rays, cast_rays_within as cast_rays_within
from ._rotation import (
    matrix_from_quaternion as matrix_from_quaternion,
    polar_rotation as polar_rotation,
    quaternion_conjugate as quaternion_conjugate,
    quaternion_from_axis_angle as quaternion_from_axis_angle,
    quaternion_multiply as quaternion_multiply,
    safe_norm as safe_norm,
    safe_normalize as safe_normalize,
    slerp as slerp,
)
from ._stencil import (
    Smoothing as Smoothing,
    Stencil as Stencil,
    gaussian_smoothing as gaussian_smoothing,
    gaussian_stencil as gaussian_stencil,
)
from ._topology import (
    boundary_loops as boundary_loops,
    connected_components as connected_components,
    greedy_coloring as greedy_coloring,
    hinges as hinges,
    manifold_report as manifold_report,
    mesh_edges as mesh_edges,
    smoothing_matrix as smoothing_matrix,
    vertex_faces as vertex_faces,
)
from ._visible_skin import VisibleSkin as VisibleSkin, visible_skin as visible_skin
