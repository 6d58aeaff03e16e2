//! Known pixels of simple scenes, determinism, bad input.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::sync::Arc;

use caudata_model::{Pose, RobotModel, Shape};
use caudata_render::{Camera, Image, Item, Quality, Scene, View, encode, render, robot_items};
use caudata_sim::{Terrain, TerrainConfig, TerrainKind};

const SMALL: Quality = Quality { width: 96, height: 64, rays: 1, threads: 1 };

fn ball_at(z: f64) -> Item {
    Item {
        shape: Shape::Sphere { radius_m: 0.3 },
        world_from_shape: Pose::from_pos([0.0, 0.0, z]),
        colour: [0.9, 0.02, 0.02],
    }
}

fn terrain(kind: TerrainKind) -> Arc<Terrain> {
    Arc::new(Terrain::generate(&TerrainConfig::of(kind), 3).unwrap())
}

fn picture(items: &[Item], kind: TerrainKind, camera: &Camera) -> Image {
    render(&Scene::new(items, terrain(kind), 0.0), camera, &SMALL).unwrap()
}

fn is_red(pixel: [u8; 3]) -> bool {
    let [r, g, b] = pixel.map(u32::from);
    r > 2 * g && r > 2 * b && r > 60
}

#[test]
fn a_ball_is_where_it_projects_and_nowhere_else() {
    let camera = Camera::orbit([0.0, 0.0, 0.3], 3.0, 0.5, 0.3).unwrap();
    let image = picture(&[ball_at(0.3)], TerrainKind::Flat, &camera);
    // the ball's centre is the camera's target: the middle of the picture
    let [x, y] = camera.project([0.0, 0.0, 0.3], 96, 64).unwrap();
    assert!((x - 48.0).abs() < 1e-9 && (y - 32.0).abs() < 1e-9);
    assert!(is_red(image.pixel(48, 32)), "{:?}", image.pixel(48, 32));
    // its radius is asin(0.3/3) of a picture of 36° over 64 pixels: tan 5.74° / tan 18° · 32 = 9.9 pixels
    let red = |x: u32| is_red(image.pixel(x, 32));
    assert!(red(48 - 8) && red(48 + 8));
    assert!(!red(48 - 12) && !red(48 + 12));
}

#[test]
fn the_sky_is_above_and_the_ball_throws_a_shadow() {
    let camera = Camera::orbit([0.0, 0.0, 0.5], 6.0, 0.0, 0.1).unwrap();
    let [r, _, b] = picture(&[], TerrainKind::Flat, &camera).pixel(48, 1);
    assert!(b > r, "the sky is blue");
    // The sun stands towards (0.37, −0.47, 0.80): a ball at 1 m shades the ground at −1·(0.37, −0.47)/0.80.
    let above = Camera::orbit([0.0, 0.0, 0.0], 6.0, 0.0, 1.2).unwrap();
    let [x, y] = above.project([-0.465, 0.592, 0.0], 96, 64).unwrap();
    let at = |image: Image| {
        let [r, g, b] = image.pixel(x as u32, y as u32).map(u32::from);
        r + g + b
    };
    let lit = at(picture(&[], TerrainKind::Flat, &above));
    let shaded = at(picture(&[ball_at(1.0)], TerrainKind::Flat, &above));
    assert!(10 * shaded < 8 * lit, "{shaded} is not darker than {lit}");
}

#[test]
fn water_covers_what_is_below_it() {
    let camera = Camera::orbit([0.0, 0.0, 2.0], 4.0, 0.0, 0.8).unwrap();
    let floating = picture(&[ball_at(2.2)], TerrainKind::DeepWater, &camera);
    let sunk = picture(&[ball_at(0.3)], TerrainKind::DeepWater, &camera);
    let red = |image: &Image| (0..96 * 64).filter(|i| is_red(image.pixel(i % 96, i / 96))).count();
    assert!(red(&floating) > 50);
    assert_eq!(red(&sunk), 0, "1.7 m of water swallow red");
}

/// A ball on the ground and one 20 cm or 4 m above it: both are in the picture, and its upper and lower edges are free.
#[test]
fn whatever_its_size_a_robot_fits_into_the_picture() {
    for above_m in [0.2, 4.0] {
        let items = [ball_at(0.3), ball_at(0.3 + above_m)];
        let target = [0.0, 0.0, 0.3 + 0.5 * above_m];
        let reach_m = Scene::new(&items, terrain(TerrainKind::Flat), 0.0).reach_m(target);
        let far_m = Camera::far_enough_m(View::Side, reach_m, 1.5);
        let camera = Camera::of_view(View::Side, target, 0.0, far_m).unwrap();
        let image = picture(&items, TerrainKind::Flat, &camera);
        let rows: Vec<u32> =
            (0..64).filter(|&y| (0..96).any(|x| is_red(image.pixel(x, y)))).collect();
        assert!(rows[0] >= 1 && rows[rows.len() - 1] <= 62, "{above_m}: {rows:?}");
        assert!(rows[0] < 16 && rows[rows.len() - 1] > 48, "{above_m}: {rows:?}");
    }
}

#[test]
fn threads_do_not_change_a_byte_and_png_and_gif_open() {
    let path =
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    let model = RobotModel::load(&path).unwrap();
    let base = Pose::from_pos([0.5, 0.0, 0.6]);
    let joints = model.full_pos_rad(model.nominal_pos_rad()).unwrap();
    let items = robot_items(&model, &base, &joints, &[true, false, false, true]).unwrap();
    assert!(items.len() >= model.links().len());
    let scene = Scene::new(&items, terrain(TerrainKind::RoughHard), 0.0);
    let camera = Camera::of_view(View::Iso, base.pos_m, 0.0, 2.0).unwrap();
    let one = render(&scene, &camera, &SMALL).unwrap();
    let many = Quality { threads: 5, ..SMALL };
    assert_eq!(one, render(&scene, &camera, &many).unwrap());
    let png = encode::png(&one).unwrap();
    assert_eq!(&png[..8], b"\x89PNG\r\n\x1a\n");
    let mut captioned = one.clone();
    captioned.caption("t = 1.00 s");
    assert_ne!(captioned, one);
    let gif = encode::gif(&[one, captioned], 0.05).unwrap();
    assert_eq!(&gif[..6], b"GIF89a");
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    assert!(Camera::orbit([0.0; 3], 0.0, 0.0, 0.0).is_err());
    assert!(Camera::orbit([0.0; 3], 1.0, f64::NAN, 0.0).is_err());
    assert!(Camera::orbit([0.0; 3], 1.0, 0.0, 1.6).is_err());
    assert!(Image::new(8, 64).is_err());
    assert!(encode::gif(&[], 0.1).is_err());
    let unlike = [Image::new(16, 16).unwrap(), Image::new(16, 32).unwrap()];
    assert!(encode::gif(&unlike, 0.1).is_err());
    let camera = Camera::orbit([0.0; 3], 1.0, 0.0, 0.5).unwrap();
    let none = Quality { rays: 0, ..SMALL };
    let scene = Scene::new(&[], terrain(TerrainKind::Flat), 0.0);
    assert!(render(&scene, &camera, &none).is_err());
}
