//! One name, one thing: a constant's name has one value in a crate.

use std::collections::BTreeMap;

use super::exceptions::{Offence, hold};
use super::product;

#[test]
fn a_constants_name_has_one_value_in_a_crate() {
    // (crate, name) → (value, where it is defined)
    let mut seen: BTreeMap<(String, String), BTreeMap<String, String>> = BTreeMap::new();
    for source in product::sources() {
        let (t, mut depth) = (&source.tokens, 0);
        for i in 0..t.len() {
            match t[i].text.as_str() {
                "{" => depth += 1,
                "}" => depth -= 1,
                // Constants of a trait or a type have as many values as there are types.
                "const" | "static" if depth == 0 => {
                    let generic = i > 0 && matches!(t[i - 1].text.as_str(), "<" | ",");
                    let name = t.get(i + 1).filter(|name| screams(&name.text) && !generic);
                    let Some(name) = name else { continue };
                    let mut equals = i;
                    let mut end = i;
                    let mut brackets = 0;
                    while end < t.len() && !(t[end].text == ";" && brackets == 0) {
                        match t[end].text.as_str() {
                            "(" | "[" | "{" => brackets += 1,
                            ")" | "]" | "}" => brackets -= 1,
                            "=" if equals == i => equals = end,
                            _ => {}
                        }
                        end += 1;
                    }
                    let value: Vec<&str> = t[equals..end].iter().map(|t| t.text.as_str()).collect();
                    let place = format!("{}:{}", source.path, name.line);
                    let key = (source.package.clone(), name.text.clone());
                    seen.entry(key).or_default().insert(value.concat(), place);
                }
                _ => {}
            }
        }
    }
    let several = seen.into_iter().filter(|(_, values)| values.len() > 1);
    let offences = several.map(|((package, name), values)| {
        let places: Vec<String> = values.into_values().collect();
        Offence::new(format!("{package} {name}"), places.join(", "))
    });
    hold("constant", offences.collect());
}

fn screams(name: &str) -> bool {
    let big = |c: char| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_';
    name.chars().all(big) && name.starts_with(|c: char| c.is_ascii_uppercase())
}
