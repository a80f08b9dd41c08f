// What stands still: scenery by material, edges, terrain, ground with a grid, and the sky.
import {
  BackSide,
  BufferAttribute,
  BufferGeometry,
  CircleGeometry,
  Color,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  ShaderMaterial,
  SphereGeometry,
} from "three";
import { decodeMesh } from "../decode";
import { edgesOf } from "./edges";
import type { Source } from "../source";
import type { About, MeshInfo, Vector } from "../types";
import type { Theme } from "./theme";

/** Meshes of more triangles than this have no edges, which would take seconds. */
const MOST_EDGED = 150_000;

const VARYING = "varying vec3 vPlace;";
const GRID = `
  vec2 cell = vPlace.xy / uGrid;
  vec2 wide = fwidth(cell);
  vec2 near = abs(fract(cell - 0.5) - 0.5) / max(wide, vec2(1e-6));
  float line = (1.0 - min(min(near.x, near.y), 1.0)) * (1.0 - smoothstep(0.15, 0.6, max(wide.x, wide.y)));
  diffuseColor.rgb = mix(diffuseColor.rgb, uGridColor, uGridOpacity * line);`;
// Walls are darker near the ground, as between real ones, where less of the sky is seen.
const CREVICE = `
  diffuseColor.rgb *= mix(0.70, 1.0, smoothstep(0.0, 14.0, vPlace.z - uGround));`;

export interface Piece {
  info: MeshInfo;
  mesh: Mesh;
}

export class World {
  readonly group = new Group();
  readonly pieces: Piece[] = [];
  private readonly edges = new Group();
  private readonly shared = {
    uGrid: { value: 10 },
    uGridColor: { value: new Color() },
    uGridOpacity: { value: 0.3 },
    uGround: { value: 0 },
  };
  private readonly sky: Mesh<SphereGeometry, ShaderMaterial>;
  private readonly ground: Mesh<CircleGeometry, MeshLambertMaterial>;
  private theme: Theme | null = null;

  /**
   * @param about scenery of the run
   * @param origin world coordinates of the scene's zero [m]
   */
  constructor(
    private readonly about: About,
    private readonly origin: Vector,
  ) {
    const { low, high } = about.bounds;
    const extent = Math.max(high[0] - low[0], high[1] - low[1], 10);
    this.shared.uGrid.value = gridSize(extent);
    this.shared.uGround.value = low[2] - origin[2];
    this.sky = new Mesh(new SphereGeometry(1, 32, 16), skyMaterial());
    this.sky.frustumCulled = false;
    this.sky.renderOrder = -10;
    this.ground = new Mesh(new CircleGeometry(40 * extent, 64), this.material("#888888", GRID));
    this.ground.position.set(
      (low[0] + high[0]) / 2 - origin[0],
      (low[1] + high[1]) / 2 - origin[1],
      low[2] - origin[2] - 0.05,
    );
    this.ground.receiveShadow = true;
    // Below all else, whatever the precision of the depth buffer is at a distance.
    this.ground.material.depthWrite = false;
    this.ground.renderOrder = -5;
    this.group.add(this.sky, this.ground, this.edges);
  }

  /** Length of a cell of the grid [m]. */
  get gridSize(): number {
    return this.shared.uGrid.value;
  }

  /** Fetch and add the meshes. */
  async load(source: Source): Promise<void> {
    await Promise.all(
      this.about.meshes.map(async (info) => {
        const { vertices, triangles } = decodeMesh(await source.bytes(`meshes/${info.id}`));
        const geometry = localGeometry(vertices, triangles, this.origin);
        const terrain = info.kind === "terrain";
        const mesh = new Mesh(geometry, this.material("#888888", terrain ? GRID : CREVICE));
        mesh.castShadow = !terrain;
        mesh.receiveShadow = true;
        // Edges lie on buildings, and roads on the ground within millimetres.
        mesh.material.polygonOffset = true;
        mesh.material.polygonOffsetFactor = mesh.material.polygonOffsetUnits = terrain ? 2 : 1;
        this.pieces.push({ info, mesh });
        this.group.add(mesh);
      }),
    );
    if (this.theme) this.setTheme(this.theme);
  }

  /** Add the edges of buildings, with pauses in which the page answers: it takes longer than all else. */
  async addEdges(): Promise<void> {
    for (const { info, mesh } of this.pieces) {
      if (info.kind !== "building" && info.kind !== "other") continue;
      if (info.triangles > MOST_EDGED) continue;
      await new Promise((resolve) => setTimeout(resolve));
      const { position } = mesh.geometry.attributes;
      const ends = edgesOf(position.array, mesh.geometry.index?.array ?? []);
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(ends, 3));
      this.edges.add(new LineSegments(geometry, new LineBasicMaterial({ transparent: true, depthWrite: false })));
    }
    if (this.theme) this.setTheme(this.theme);
  }

  setTheme(theme: Theme): void {
    this.theme = theme;
    for (const { info, mesh } of this.pieces) {
      const color = this.about.materials[info.material]?.color ?? [0.7, 0.7, 0.7];
      (mesh.material as MeshLambertMaterial).color.setRGB(...color, "srgb").multiplyScalar(theme.shade);
    }
    this.ground.material.color.set(theme.ground);
    this.shared.uGridColor.value.set(theme.grid);
    this.sky.material.uniforms.uZenith.value.set(theme.zenith);
    this.sky.material.uniforms.uHorizon.value.set(theme.horizon);
    for (const line of this.edges.children as LineSegments<BufferGeometry, LineBasicMaterial>[]) {
      line.material.color.set(theme.edges);
      line.material.opacity = theme.edgeOpacity;
    }
  }

  show(layers: ReadonlySet<string>): void {
    for (const { info, mesh } of this.pieces) mesh.visible = layers.has(info.kind === "terrain" ? "terrain" : "buildings");
    this.edges.visible = layers.has("buildings");
    this.shared.uGridOpacity.value = layers.has("grid") ? 0.35 : 0;
  }

  /** Name of the piece that a triangle of a mesh belongs to. */
  pieceName(info: MeshInfo, triangle: number): string {
    return info.parts?.findLast(([, start]) => start <= triangle)?.[0] ?? info.name;
  }

  private material(color: string, detail: string): MeshLambertMaterial {
    const material = new MeshLambertMaterial({ color, flatShading: true, side: 2 });
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.shared);
      shader.vertexShader = `${VARYING}\n${shader.vertexShader}`.replace(
        "#include <begin_vertex>",
        "#include <begin_vertex>\n  vPlace = (modelMatrix * vec4(transformed, 1.0)).xyz;",
      );
      const uniforms = "uniform float uGrid, uGridOpacity, uGround;\nuniform vec3 uGridColor;";
      shader.fragmentShader = `${VARYING}\n${uniforms}\n${shader.fragmentShader}`.replace(
        "#include <color_fragment>",
        `#include <color_fragment>\n${detail}`,
      );
    };
    material.customProgramCacheKey = () => detail;
    return material;
  }
}

/** A round length of which there are about 10 to 25 in the extent [m]. */
export function gridSize(extent: number): number {
  const power = 10 ** Math.floor(Math.log10(extent / 10));
  return [5, 2, 1].map((factor) => factor * power).find((size) => extent / size >= 10) ?? power;
}

/** Geometry of a mesh around the origin: single precision is millimetres at most 10 km from zero. */
function localGeometry(vertices: Float32Array, triangles: Uint32Array, origin: Vector): BufferGeometry {
  const local = new Float32Array(vertices.length);
  for (let i = 0; i < vertices.length; i++) local[i] = vertices[i] - origin[i % 3];
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(local, 3));
  geometry.setIndex(new BufferAttribute(triangles, 1));
  geometry.computeVertexNormals();
  return geometry;
}

function skyMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    side: BackSide,
    depthWrite: false,
    depthTest: false,
    fog: false,
    uniforms: { uZenith: { value: new Color() }, uHorizon: { value: new Color() } },
    vertexShader: `
      varying vec3 vDirection;
      void main() {
        vDirection = position;
        gl_Position = projectionMatrix * vec4(mat3(viewMatrix) * position, 1.0);
        // Behind all else: its own distance may be before the nearest place.
        gl_Position.z = 0.999 * gl_Position.w;
      }`,
    fragmentShader: `
      uniform vec3 uZenith, uHorizon;
      varying vec3 vDirection;
      void main() {
        float height = clamp(normalize(vDirection).z, 0.0, 1.0);
        gl_FragColor = vec4(mix(uHorizon, uZenith, pow(height, 0.6)), 1.0);
        #include <colorspace_fragment>
      }`,
  });
}
