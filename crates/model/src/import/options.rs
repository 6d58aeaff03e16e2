//! What a file cannot say itself.

/// How a file is to be taken.
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Name of the robot; default: the file's own.
    pub name: Option<String>,
    /// For a URDF: whether the root link is free; default: whether it has several legs.
    pub free_base: Option<bool>,
    /// Joints that stay where they are.
    pub weld: Vec<Weld>,
}

/// A joint that is to stay where it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Weld {
    /// Its name in the file.
    pub joint: String,
    /// Where, rad or m; default: where the file's pose has it, else 0.
    pub at: Option<f64>,
}

/// `JOINT` or `JOINT=POSITION`.
impl std::str::FromStr for Weld {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (joint, at) =
            text.rsplit_once('=').map_or((text, None), |(joint, at)| (joint, Some(at)));
        let number = |at: &str| at.parse().ok().filter(|at| f64::is_finite(*at));
        let wrong = |at: &str| format!("`{at}` is no number of radians or metres");
        let at = at.map(|at| number(at).ok_or_else(|| wrong(at))).transpose()?;
        Ok(Self { joint: joint.to_owned(), at })
    }
}
