//! What a collider belongs to, as its `user_data` says.

/// `user_data` of the ground's colliders; see [`foot_tag`] for the rest.
pub(super) const GROUND_TAG: u128 = 0;
/// `user_data` of the colliders that are no feet, on links that carry feet.
pub(super) const TRUNK_TAG: u128 = u128::MAX;
/// `user_data` of the colliders of all other links.
pub(super) const TAIL_TAG: u128 = u128::MAX - 1;

/// `user_data` of foot `index`'s collider.
pub(super) fn foot_tag(index: usize) -> u128 {
    index as u128 + 1
}

/// The foot whose collider has this tag.
pub(super) fn foot_of(tag: u128) -> Option<usize> {
    match tag {
        GROUND_TAG | TRUNK_TAG | TAIL_TAG => None,
        foot => Some(foot as usize - 1),
    }
}
