//! Every baseline on case folders: `baselines EFFECT CASE…`.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::baselines::{data::CaseData, fit, residual};
fn main() {
    for folder in std::env::args().skip(1) {
        let folder = std::path::PathBuf::from(folder);
        let name = folder.file_name().unwrap().to_string_lossy().into_owned();
        let data = CaseData::read(&folder).unwrap();
        let now = std::time::Instant::now();
        let lap = || now.elapsed().as_secs_f64();
        let (f, names) = fit::fit_all(&data).unwrap();
        println!(
            "{name}: least squares {:.3} {names:?} {:.1} s",
            data.holdout_ratio(&f.setup(&data)).unwrap(),
            lap()
        );
        let (f, names) = fit::evolve(&data, 25).unwrap();
        println!(
            "{name}: evolution {:.3} {names:?} {:.1} s",
            data.holdout_ratio(&f.setup(&data)).unwrap(),
            lap()
        );
        let (f, names) = fit::forward_selection(&data).unwrap();
        println!(
            "{name}: selection {:.3} {names:?} {:?} {:.1} s",
            data.holdout_ratio(&f.setup(&data)).unwrap(),
            f.x,
            lap()
        );
        println!(
            "{name}: residual {:.3} {:.1} s",
            residual::holdout_ratio(&data).unwrap(),
            lap()
        );
        let joint = data.model.actuated_names()[0].to_owned();
        if let Some(f) = fit::oracle(&data, &[(name.clone(), joint)]).unwrap() {
            println!(
                "{name}: oracle {:.3} {:?} {:.1} s",
                data.holdout_ratio(&f.setup(&data)).unwrap(),
                f.x,
                lap()
            );
        }
    }
}
