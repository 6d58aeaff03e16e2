//! What can be hidden: effects of the catalogue, as physics in the truth, and laws that the catalogue does
//! not have.
//!
//! `size` grows with the effect and is 0 where there is none; what it means is in each row.

mod catalogue;
mod outside;
mod row;

pub use catalogue::CATALOGUE;
pub use outside::OUTSIDE;
pub use row::{Hidden, Scope, TrueParameter, World};

/// The row of an id, in the catalogue or outside it.
pub fn find(id: &str) -> Option<&'static Hidden> {
    CATALOGUE.iter().chain(OUTSIDE).find(|h| h.id == id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn ids_are_unique_and_sizes_in_order() {
        let ids: BTreeSet<&str> = CATALOGUE.iter().chain(OUTSIDE).map(|h| h.id).collect();
        assert_eq!(ids.len(), CATALOGUE.len() + OUTSIDE.len());
        assert!(OUTSIDE.len() >= 8);
        for h in CATALOGUE.iter().chain(OUTSIDE) {
            assert!(0.0 < h.sizes.0 && h.sizes.0 < h.sizes.1, "{}", h.id);
        }
    }
}
