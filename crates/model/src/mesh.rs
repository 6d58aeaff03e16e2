//! Mesh files: how far they reach and what they hold. STL and OBJ.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::geometry::Solid;
use crate::pose::{Pose, cross, dot, norm, quat_normalised, sub};
use crate::tree::{Element, Remarks};

/// Largest mesh file that is read, bytes.
const MESH_LIMIT_BYTES: u64 = 64 * 1024 * 1024;

/// How a mesh's volume is counted (attribute `inertia` of MuJoCo's `<mesh>`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Volumes {
    /// MuJoCo's default: each triangle's tetrahedron counts as positive, from the middle of the surface and
    /// then from the centre of mass that this gives. Too much where the mesh is hollow or not convex, but
    /// something where it is not closed.
    Legacy,
    /// Signed: exact where the mesh is closed.
    Exact,
}

/// What is kept of a mesh.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mesh {
    pub middle_m: [f64; 3],
    pub half_size_m: [f64; 3],
    pub solid: Solid,
}

/// Where a mesh is, and how it is to be read.
struct Asset {
    path: PathBuf,
    scale: [f64; 3],
    /// What of the file becomes the mesh's own frame, before it is scaled.
    origin: Pose,
    volumes: Volumes,
}

/// The meshes of a file, read when they are asked for.
#[derive(Default)]
pub(crate) struct Meshes {
    files: BTreeMap<String, Asset>,
    read: BTreeMap<String, Option<Mesh>>,
}

impl Meshes {
    /// The `<mesh>` assets of an MJCF, with what their classes say.
    pub fn read(meshes: &[Element], root: &Element, file: &Path, remarks: &mut Remarks) -> Self {
        let folder = |key: &str| root.all("compiler").filter_map(|c| c.get(key)).last();
        let folder = folder("meshdir").or_else(|| folder("assetdir")).unwrap_or("");
        let mut files = BTreeMap::new();
        for mesh in meshes {
            let Some(path) = mesh.get("file") else { continue };
            let stem = Path::new(path).file_stem().map(|s| s.to_string_lossy().into_owned());
            let name = mesh.get("name").map(str::to_owned).or(stem).unwrap_or_default();
            let scale = mesh.array("scale", remarks).unwrap_or([1.0; 3]);
            let origin = Pose {
                pos_m: mesh.array("refpos", remarks).unwrap_or_default(),
                quat_wxyz: mesh
                    .array("refquat", remarks)
                    .and_then(quat_normalised)
                    .unwrap_or(Pose::IDENTITY.quat_wxyz),
            };
            let path = file.with_file_name("").join(folder).join(path);
            let volumes = match mesh.get("inertia") {
                None | Some("legacy") => Volumes::Legacy,
                Some("exact") => Volumes::Exact,
                Some(other) => {
                    let what = format!("inertia=\"{other}\" is not read; counted as \"legacy\"");
                    remarks.note_of(mesh, what);
                    Volumes::Legacy
                }
            };
            files.insert(name, Asset { path, scale, origin, volumes });
        }
        Self { files, read: BTreeMap::new() }
    }

    /// Names a file beside those of the assets.
    pub fn add(&mut self, name: &str, path: PathBuf, scale: [f64; 3]) {
        let asset = Asset { path, scale, origin: Pose::IDENTITY, volumes: Volumes::Exact };
        self.files.insert(name.to_owned(), asset);
    }

    /// A mesh by name; `None`: there is none, or it cannot be read.
    pub fn find(&mut self, name: &str) -> Option<Mesh> {
        if let Some(known) = self.read.get(name) {
            return *known;
        }
        let mesh = self.files.get(name).and_then(load);
        self.read.insert(name.to_owned(), mesh);
        mesh
    }
}

type Triangle = [[f64; 3]; 3];

fn load(asset: &Asset) -> Option<Mesh> {
    let Asset { path, scale, origin, volumes } = asset;
    let bytes = caudata_durable::read_at_most(path, MESH_LIMIT_BYTES).ok()?;
    let kind = path.extension()?.to_string_lossy().to_lowercase();
    let mut triangles = match kind.as_str() {
        "stl" => stl(&bytes)?,
        "obj" => obj(&String::from_utf8_lossy(&bytes))?,
        _ => return None,
    };
    let turned = *origin != Pose::IDENTITY;
    for vertex in triangles.iter_mut().flatten() {
        if turned {
            *vertex = origin.inverse().point(*vertex);
        }
        for (x, s) in vertex.iter_mut().zip(scale) {
            *x *= s;
        }
    }
    measure(&triangles, *volumes)
}

/// Integrals over the tetrahedra that the triangles span with a point: volume, first and second moments about
/// that point, for density 1.
fn integrals(
    triangles: &[Triangle],
    from: [f64; 3],
    volumes: Volumes,
) -> (f64, [f64; 3], [[f64; 3]; 3]) {
    let (mut volume, mut first, mut second) = (0.0, [0.0; 3], [[0.0; 3]; 3]);
    for corners in triangles {
        let [a, b, c] = corners.map(|corner| sub(corner, from));
        // ∫ x xᵀ = V/20·(Σ vᵢvᵢᵀ + (Σ vᵢ)(Σ vᵢ)ᵀ)
        let mut v = dot(a, cross(b, c)) / 6.0;
        if volumes == Volumes::Legacy {
            v = v.abs();
        }
        let sum = [0, 1, 2].map(|i| a[i] + b[i] + c[i]);
        volume += v;
        for r in 0..3 {
            first[r] += v * sum[r] / 4.0;
            for s in 0..3 {
                let squares = a[r] * a[s] + b[r] * b[s] + c[r] * c[s];
                second[r][s] += v / 20.0 * (squares + sum[r] * sum[s]);
            }
        }
    }
    (volume, first, second)
}

/// The middle of the surface, each triangle weighted by its area.
fn surface_centre(triangles: &[Triangle]) -> [f64; 3] {
    let (mut total, mut sum) = (0.0, [0.0; 3]);
    for [a, b, c] in triangles {
        let area = norm(cross(sub(*b, *a), sub(*c, *a)));
        total += area;
        for i in 0..3 {
            sum[i] += area * (a[i] + b[i] + c[i]) / 3.0;
        }
    }
    sum.map(|x| x / total.max(f64::MIN_POSITIVE))
}

/// Box and volume.
fn measure(triangles: &[Triangle], volumes: Volumes) -> Option<Mesh> {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for vertex in triangles.iter().flatten() {
        for i in 0..3 {
            low[i] = low[i].min(vertex[i]);
            high[i] = high[i].max(vertex[i]);
        }
    }
    if triangles.is_empty() || !low.iter().chain(&high).all(|x| x.is_finite()) {
        return None;
    }
    let middle_m = [0, 1, 2].map(|i| 0.5 * (low[i] + high[i]));
    let half_size_m = [0, 1, 2].map(|i| 0.5 * (high[i] - low[i]));
    let from = surface_centre(triangles);
    let (volume, first, _) = integrals(triangles, from, volumes);
    if volume.abs() < 1e-15 {
        return None;
    }
    let centre_m = [0, 1, 2].map(|i| from[i] + first[i] / volume);
    let (volume, _, second) = integrals(triangles, centre_m, volumes);
    let about = |r: usize, s: usize| volume.signum() * second[r][s];
    let trace = about(0, 0) + about(1, 1) + about(2, 2);
    let mut moments = [[0.0; 3]; 3];
    for r in 0..3 {
        for s in 0..3 {
            moments[r][s] = if r == s { trace } else { 0.0 } - about(r, s);
        }
    }
    Some(Mesh {
        middle_m,
        half_size_m,
        solid: Solid { volume_m3: volume.abs(), centre_m, moments },
    })
}

/// Binary, or else text.
fn stl(bytes: &[u8]) -> Option<Vec<Triangle>> {
    const HEAD: usize = 84;
    const RECORD: usize = 50;
    let count = bytes.get(80..HEAD).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    if count.is_some_and(|n| n.checked_mul(RECORD).is_some_and(|len| bytes.len() == HEAD + len)) {
        let record = |r: &[u8]| {
            let number = |i: usize| {
                let at = 12 + 4 * i;
                f64::from(f32::from_le_bytes([r[at], r[at + 1], r[at + 2], r[at + 3]]))
            };
            [0, 3, 6].map(|v| [number(v), number(v + 1), number(v + 2)])
        };
        return Some(bytes[HEAD..].chunks_exact(RECORD).map(record).collect());
    }
    let text = std::str::from_utf8(bytes).ok()?;
    let vertices = text.lines().filter_map(|l| l.trim().strip_prefix("vertex"));
    let vertices: Vec<[f64; 3]> = vertices.map(three).collect::<Option<_>>()?;
    let (triangles, rest) = vertices.as_chunks::<3>();
    (rest.is_empty() && !triangles.is_empty()).then(|| triangles.to_vec())
}

/// Faces as fans of triangles.
fn obj(text: &str) -> Option<Vec<Triangle>> {
    let mut vertices: Vec<[f64; 3]> = Vec::new();
    let mut triangles = Vec::new();
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("v ") {
            vertices.push(three(rest)?);
        } else if let Some(rest) = line.strip_prefix("f ") {
            let index = |word: &str| {
                let number: i64 = word.split('/').next()?.parse().ok()?;
                let at = if number < 0 { vertices.len() as i64 + number } else { number - 1 };
                vertices.get(usize::try_from(at).ok()?).copied()
            };
            let corners: Vec<[f64; 3]> =
                rest.split_whitespace().map(index).collect::<Option<_>>()?;
            for pair in corners.get(1..)?.windows(2) {
                triangles.push([corners[0], pair[0], pair[1]]);
            }
        }
    }
    Some(triangles)
}

fn three(text: &str) -> Option<[f64; 3]> {
    let numbers: Vec<f64> =
        text.split_whitespace().take(3).map(|w| w.parse().ok()).collect::<Option<_>>()?;
    numbers.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box of 2 × 4 × 6, its corner at the origin.
    const BOX: &str = "v 0 0 0\nv 2 0 0\nv 2 4 0\nv 0 4 0\nv 0 0 6\nv 2 0 6\nv 2 4 6\nv 0 4 6\n\
        f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";

    #[test]
    fn a_box_as_a_mesh_has_the_box_s_volume_centre_and_moments() {
        for volumes in [Volumes::Legacy, Volumes::Exact] {
            let mesh = measure(&obj(BOX).unwrap(), volumes).unwrap();
            assert_eq!((mesh.middle_m, mesh.half_size_m), ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]));
            assert!((mesh.solid.volume_m3 - 48.0).abs() < 1e-9);
            for i in 0..3 {
                assert!((mesh.solid.centre_m[i] - mesh.middle_m[i]).abs() < 1e-9);
            }
            // V/12·(4² + 6²) = 208
            assert!((mesh.solid.moments[0][0] - 208.0).abs() < 1e-6);
            assert!(mesh.solid.moments[0][1].abs() < 1e-6);
        }
    }

    /// A cube of 3 with a cube of 1 taken out of its middle: 26, and with each tetrahedron as positive 28.
    #[test]
    fn hollow_meshes_weigh_more_where_all_counts_as_positive() {
        let cube = |low: f64, high: f64, first: usize| {
            let mut text = String::new();
            for z in [low, high] {
                for (x, y) in [(low, low), (high, low), (high, high), (low, high)] {
                    text += &format!("v {x} {y} {z}\n");
                }
            }
            let faces = [
                [1, 4, 3, 2],
                [5, 6, 7, 8],
                [1, 2, 6, 5],
                [2, 3, 7, 6],
                [3, 4, 8, 7],
                [4, 1, 5, 8],
            ];
            for mut face in faces {
                if first > 0 {
                    face.reverse();
                }
                let [a, b, c, d] = face.map(|i| i + first);
                text += &format!("f {a} {b} {c} {d}\n");
            }
            text
        };
        let hollow = obj(&(cube(0.0, 3.0, 0) + &cube(1.0, 2.0, 8))).unwrap();
        for (volumes, volume_m3) in [(Volumes::Exact, 26.0), (Volumes::Legacy, 28.0)] {
            let mesh = measure(&hollow, volumes).unwrap();
            assert!((mesh.solid.volume_m3 - volume_m3).abs() < 1e-9);
            assert!((mesh.solid.centre_m[0] - 1.5).abs() < 1e-9);
        }
    }

    #[test]
    fn damaged_files_are_no_meshes() {
        assert!(obj("v 0 0\n").is_none());
        assert!(obj("v 0 0 0\nf 1 2 3\n").is_none());
        assert!(stl(b"solid x\nvertex 0 0 0\n").is_none());
        assert!(stl(&[0; 83]).is_none());
    }
}
