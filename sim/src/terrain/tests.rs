//! Worked examples: each kind's heights against numbers worked out by hand.

use super::*;

fn grid(config: &TerrainConfig, seed: u64) -> HeightGrid {
    Terrain::generate(config, seed).unwrap().grid.expect("a height field")
}

fn terrain(kind: TerrainKind) -> Terrain {
    Terrain::generate(&TerrainConfig::of(kind), 3).unwrap()
}

fn near(got: f32, want: f64) {
    assert!((f64::from(got) - want).abs() < 2e-5, "{got} is not {want}");
}

#[test]
fn heights_are_interpolated_on_two_triangles() {
    // One cell of 2 m: corners h00 = 0, h10 = 1, h01 = 2, h11 = 5 (first index x).
    let t = Terrain {
        grid: Some(HeightGrid::new(2, 2.0, vec![0.0, 1.0, 2.0, 5.0], vec![0.5; 4])),
        water_level_m: None,
    };
    // u = 0.75, v = 0.25 (right triangle): 0 + 0.75·1 + 0.25·(5 − 1) = 1.75
    near(t.height_m(0.5, -0.5), 1.75);
    // u = 0.25, v = 0.75 (left triangle): 0 + 0.25·(5 − 2) + 0.75·2 = 2.25
    near(t.height_m(-0.5, 0.5), 2.25);
    // slopes there: ∂x = 3/2, ∂y = 2/2 → normal ∝ (−1.5, −1, 1), length √4.25
    let n = t.normal(-0.5, 0.5);
    let l = 4.25_f64.sqrt();
    for (got, want) in n.iter().zip([-1.5 / l, -1.0 / l, 1.0 / l]) {
        near(*got, want);
    }
    assert_eq!((t.friction_factor(0.0, 0.0), t.friction_factor(1.5, 0.0)), (0.5, 1.0));
    assert_eq!(t.height_m(1.5, 0.0), -APRON_DROP_M as f32);
    assert_eq!(t.height_m(f32::NAN, 0.0), -APRON_DROP_M as f32);
}

#[test]
fn the_layout_is_as_documented() {
    let g = grid(&TerrainConfig::of(TerrainKind::Valley), 0);
    let (ix, iy) = (50, 105);
    let half = g.size_m() / 2.0;
    let (x, y) = (ix as f64 * g.cell_m - half, iy as f64 * g.cell_m - half);
    assert_eq!(g.points(), 161);
    assert_eq!(g.at(ix, iy), g.heights_m()[iy * 161 + ix]);
    // y = 2.5: 2 m of wall at 15°
    assert!((y - 2.5).abs() < 1e-9 && x < 0.0);
    near(g.at(ix, iy), 2.0 * 15f64.to_radians().tan());
}

#[test]
fn hills_and_grades_reach_their_slope_and_no_more() {
    for (kind, slope_deg, rough_m) in [
        (TerrainKind::Hills, 15.0_f64, 0.0),
        (TerrainKind::RoughEasy, 15.0, 0.02),
        (TerrainKind::RoughHard, 25.0, 0.04),
    ] {
        let g = grid(&TerrainConfig::of(kind), 3);
        let mut steepest = 0.0_f64;
        for i in 0..4000 {
            // inside the margin, points off the grid lines
            let x = -6.9 + f64::from(i % 63) * 0.219;
            let y = -6.9 + f64::from(i / 63) * 0.217;
            let (_, [sx, sy]) = g.sample(x, y).unwrap();
            steepest = steepest.max(sx.hypot(sy));
        }
        // Heights within 0..r at points 0.1 m apart add at most r/0.1 along each axis of a facet.
        let limit = slope_deg.to_radians().tan() + rough_m / 0.1 * 2f64.sqrt();
        assert!(steepest <= limit + 1e-6, "{kind:?}: slope {steepest}");
        assert!(steepest > 0.6 * limit, "{kind:?}: slope {steepest}");
    }
}

#[test]
fn rugged_stays_within_its_height_and_ends_at_zero() {
    let g = grid(&TerrainConfig::of(TerrainKind::Rugged), 3);
    assert!(g.heights_m().iter().all(|&h| (0.0..=0.04).contains(&h)));
    assert!(g.heights_m().iter().any(|&h| h > 0.038));
    assert!((0..g.points()).all(|i| g.at(i, 0) == 0.0 && g.at(0, i) == 0.0));
}

#[test]
fn the_slope_is_one_plane() {
    let t = terrain(TerrainKind::Slope);
    let tan = 15f64.to_radians().tan();
    near(t.height_m(0.0, 0.0), 8.0 * tan);
    near(t.height_m(-3.3, 5.0), 4.7 * tan);
    let n = t.normal(2.22, -1.0);
    near(n[0], -15f64.to_radians().sin());
    near(n[2], 15f64.to_radians().cos());
}

#[test]
fn steps_drop_every_step_length() {
    // Terraces of 1.5 m around 0, ±1.5, … ; the last begins at x = 7.5: five more below the middle one.
    let t = terrain(TerrainKind::Steps);
    near(t.height_m(0.0, 0.0), 5.0 * 0.04);
    near(t.height_m(0.72, 3.0), 5.0 * 0.04);
    near(t.height_m(0.76, 3.0), 4.0 * 0.04);
    near(t.height_m(-0.76, 3.0), 6.0 * 0.04);
    near(t.height_m(7.9, 0.0), 0.0);
    // the riser is one cell of 2 cm: 4 cm in 2 cm
    near(t.normal(0.75, 0.0)[2], 1.0 / 5f64.sqrt());
}

#[test]
fn slippery_ground_is_level_with_patches() {
    let t = terrain(TerrainKind::Slippery);
    assert!(t.has_patches());
    let places =
        (0..150 * 150).map(|i| ((i % 150) as f32 * 0.1 - 7.45, (i / 150) as f32 * 0.1 - 7.45));
    let mut slippery = 0;
    for (x, y) in places {
        assert_eq!(t.height_m(x, y), 0.0);
        match t.friction_factor(x, y) {
            0.25 => slippery += 1,
            f => assert_eq!(f, 1.0),
        }
    }
    // share 0.3 of about 2,500 independent patches: ±0.04 is over four standard deviations
    let share = f64::from(slippery) / 22_500.0;
    assert!((share - 0.3).abs() < 0.04, "share {share}");
    assert!(!terrain(TerrainKind::Rough).has_patches());
}

#[test]
fn the_shore_goes_from_dry_land_into_the_pool() {
    let t = terrain(TerrainKind::Shore);
    near(t.water_level_m.unwrap(), 0.4);
    near(t.height_m(0.0, 0.0), 0.5);
    // the beach falls 0.1 m to the water in 0.1/tan 15° = 0.373 m
    let tan = 15f64.to_radians().tan();
    near(t.height_m(1.5, 2.0), 0.5 - tan);
    near(t.height_m(4.0, 2.0), 0.0);
}

#[test]
fn the_ground_grows_harder_from_right_to_left() {
    let graded = |kind| {
        let config = TerrainConfig { easiest_share: 0.5, ..TerrainConfig::of(kind) };
        Terrain::generate(&config, 3).unwrap()
    };
    // 16 m wide: at y = −8 half as hard, at −4 five eighths, at 8 as hard as without
    let steep = 15f64.to_radians().tan();
    let shore = graded(TerrainKind::Shore);
    near(shore.height_m(1.5, -4.0), 0.5 - 0.625 * steep);
    near(shore.height_m(1.5, 4.0), 0.5 - 0.875 * steep);
    let (steps, all) = (graded(TerrainKind::Steps), terrain(TerrainKind::Steps));
    let drop = |t: &Terrain, y| t.height_m(0.0, y) - t.height_m(1.5, y);
    near(drop(&all, -4.0), 0.04);
    near(drop(&steps, -4.0), 0.025);
    near(drop(&steps, 8.0), 0.04);
    // rugged, away from its margin: nowhere higher than its share of 4 cm, but nearly so somewhere
    let rugged =
        grid(&TerrainConfig { easiest_share: 0.5, ..TerrainConfig::of(TerrainKind::Rugged) }, 3);
    let row = |iy: usize| (20..140).map(move |ix| (ix, iy));
    for (iy, most) in [(20, 0.02 * 1.125), (140, 0.02 * 1.875)] {
        let highest = row(iy).map(|(x, y)| rugged.at(x, y)).fold(0.0, f32::max);
        assert!(f64::from(highest) <= most && f64::from(highest) > 0.9 * most);
    }
}

#[test]
fn water_stands_where_it_should() {
    assert_eq!(terrain(TerrainKind::Rough).water_level_m, None);
    let pool = terrain(TerrainKind::DeepWater);
    assert_eq!((pool.water_level_m, pool.height_m(3.0, 50.0)), (Some(2.0), 0.0));
    let flooded = TerrainConfig { water_level_m: 0.25, ..TerrainConfig::of(TerrainKind::Hills) };
    let flooded = Terrain::generate(&flooded, 1).unwrap();
    assert_eq!(flooded.water_level_m, Some(0.25));
}

#[test]
fn same_seed_same_ground_and_the_fingerprint_tells_them_apart() {
    let drawn =
        [TerrainKind::Hills, TerrainKind::Rugged, TerrainKind::RoughMedium, TerrainKind::Slippery];
    let make = |kind, seed| Terrain::generate(&TerrainConfig::of(kind), seed).unwrap();
    for kind in drawn {
        assert_eq!(make(kind, 7), make(kind, 7));
        assert_ne!(make(kind, 7), make(kind, 8));
        assert_ne!(make(kind, 7).fingerprint(), make(kind, 8).fingerprint());
    }
    // a map needs a file
    let kinds = TerrainKind::ALL.iter().filter(|k| **k != TerrainKind::Map);
    let mut all: Vec<u64> = kinds.map(|&k| make(k, 7).fingerprint()).collect();
    all.sort_unstable();
    all.dedup();
    // `rough` with its defaults is `rough_medium`
    assert_eq!(all.len(), TerrainKind::ALL.len() - 2);
}

#[test]
fn refuses_what_is_out_of_range() {
    let message = |config: TerrainConfig| Terrain::generate(&config, 0).unwrap_err().to_string();
    let tiny = TerrainConfig { cell_m: 0.001, ..TerrainConfig::of(TerrainKind::Rugged) };
    assert!(message(tiny).starts_with("terrain.cell_m = 0.001"));
    let many =
        TerrainConfig { size_m: 100.0, cell_m: 0.02, ..TerrainConfig::of(TerrainKind::Rugged) };
    assert!(message(many).contains("2048 grid points"));
    let fine_steps = TerrainConfig { size_m: 100.0, ..TerrainConfig::of(TerrainKind::Steps) };
    assert!(message(fine_steps).contains("2048 grid points"));
    let nan = TerrainConfig { slope_deg: f64::NAN, ..TerrainConfig::of(TerrainKind::Hills) };
    assert!(message(nan).contains("slope_deg"));
    let level_shore = TerrainConfig { slope_deg: 0.0, ..TerrainConfig::of(TerrainKind::Shore) };
    assert!(message(level_shore).contains("shore"));
    assert!(serde_json::from_str::<TerrainConfig>(r#"{ "kind": "lava" }"#).is_err());
    assert!(serde_json::from_str::<TerrainConfig>(r#"{ "depth": 1 }"#).is_err());
}

#[test]
fn a_kind_is_called_the_same_everywhere() {
    for kind in TerrainKind::ALL {
        let text = serde_json::to_string(&kind).unwrap();
        assert_eq!(text, format!("\"{}\"", kind.name()));
    }
}

#[test]
fn the_mixed_ground_has_one_kind_in_each_square() {
    let config = TerrainConfig { size_m: 32.0, ..TerrainConfig::of(TerrainKind::Mixed) };
    let t = Terrain::generate(&config, 5).unwrap();
    let along = |x0: f32, y0: f32| -> Vec<f32> {
        (0..120)
            .map(|i| t.height_m(x0 + 0.1 * (i % 12) as f32, y0 + 0.1 * (i / 12) as f32))
            .collect()
    };
    let [low, high] = [f32::min, f32::max]
        .map(|of| move |heights: &[f32]| heights.iter().copied().reduce(of).unwrap());
    // flat
    assert_eq!(high(&along(-9.0, -9.0)), 0.0);
    // rugged: 120 independent heights of 0 to 4 cm
    let rugged = along(-9.0, 9.0);
    assert!(low(&rugged) < 0.005 && high(&rugged) > 0.035 && high(&rugged) <= 0.04);
    // hills: smooth (neighbours 0.1 m apart differ by 0.1·tan 15° at most), and higher than the rugged ground
    let hills = along(9.0, -9.0);
    assert!(hills.windows(2).all(|w| (w[1] - w[0]).abs() < 0.028 * 12.0));
    assert!(high(&along(4.0, -6.0)) > 0.04 || high(&hills) > 0.04);
    // valley: its floor in the middle of the square (y = 8), 2 m to the side (2 − 0.5)·tan 15° up
    near(t.height_m(8.0, 8.0), 0.0);
    near(t.height_m(8.0, 10.0), 1.5 * 15f64.to_radians().tan());
    // borders at 0
    for at in [-8.0, 3.0, 9.0] {
        near(t.height_m(at, 0.0), 0.0);
        near(t.height_m(0.0, at), 0.0);
    }
}
