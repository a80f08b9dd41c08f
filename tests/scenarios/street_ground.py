"""A ground of 120 m × 120 m, as SPEC.md has it."""

GROUND = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
-60 -60 0
60 -60 0
60 60 0
-60 60 0
3 0 1 2
3 0 2 3
"""

GROUND_XML = """<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="mat-concrete">
    <string name="type" value="concrete"/>
    <float name="thickness" value="0.2"/>
  </bsdf>
  <shape type="ply" id="mesh-ground">
    <string name="filename" value="meshes/ground.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-concrete" name="bsdf"/>
  </shape>
</scene>
"""
