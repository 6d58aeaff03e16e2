//! Declarations in one place: [`settings!`] puts a field's default beside the field, [`named!`] a variant's name
//! beside the variant. Neither can be forgotten, and neither stands somewhere else.

/// A struct whose fields stand beside their defaults, and its `Default`. A field without one takes its type's.
///
/// ```
/// caudata_declare::settings! {
///     /// How a thing is done.
///     #[derive(Debug, PartialEq)]
///     pub struct Thing {
///         /// Times that it is done.
///         pub times: u32 = 3,
///         /// Who does it; nobody by default.
///         pub who: Option<String>,
///     }
/// }
/// assert_eq!(Thing::default(), Thing { times: 3, who: None });
/// ```
#[macro_export]
macro_rules! settings {
    ($(#[$about:meta])* $visible:vis struct $name:ident {
        $($(#[$field_about:meta])* $field_visible:vis $field:ident: $type:ty $(= $default:expr)?,)*
    }) => {
        $(#[$about])*
        $visible struct $name {
            $($(#[$field_about])* $field_visible $field: $type,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self {
                    $($field: $crate::or_default!($($default)?),)*
                }
            }
        }
    };
}

/// An enum whose variants stand beside their names, with `ALL` of them in order, `name` and `of_name`.
///
/// ```
/// caudata_declare::named! {
///     /// A colour.
///     #[derive(Clone, Copy, Debug, PartialEq)]
///     pub enum Colour {
///         /// As blood.
///         Red = "red",
///         /// As the sky.
///         Blue = "sky blue",
///     }
/// }
/// assert_eq!(Colour::ALL.map(Colour::name), ["red", "sky blue"]);
/// assert_eq!(Colour::of_name("red"), Some(Colour::Red));
/// ```
#[macro_export]
macro_rules! named {
    ($(#[$about:meta])* $visible:vis enum $name:ident {
        $($(#[$variant_about:meta])* $variant:ident = $text:literal,)+
    }) => {
        $(#[$about])*
        $visible enum $name {
            $($(#[$variant_about])* $variant,)+
        }

        #[allow(dead_code)] // a private enum need not use all three
        impl $name {
            /// All of them, in the order of the declaration.
            $visible const ALL: [Self; [$($text),+].len()] = [$(Self::$variant),+];

            /// Its name in files, logs and on the command line.
            $visible const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $text,)+
                }
            }

            /// The one that has this name.
            $visible fn of_name(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|one| one.name() == name)
            }
        }
    };
}

/// A default that is given, or the type's own.
#[doc(hidden)]
#[macro_export]
macro_rules! or_default {
    () => {
        Default::default()
    };
    ($given:expr) => {
        $given
    };
}
