//! Rust source as words, without comments and without what is compiled for tests only.

/// A word, a literal or a sign of Rust source.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// As it is written; `::` and `->` are one sign each.
    pub text: String,
    /// Line, from 1.
    pub line: usize,
}

impl Token {
    /// Whether it is an identifier or a keyword.
    pub fn is_word(&self) -> bool {
        self.text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
    }
}

/// All tokens of `text`, comments left out.
pub fn read(text: &str) -> Vec<Token> {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let (mut out, mut i, mut line) = (Vec::new(), 0, 1);
    while i < chars.len() {
        let start = i;
        let c = chars[i];
        if c.is_whitespace() {
            i += 1;
        } else if c == '/' && at(i + 1) == '/' {
            i = (i..chars.len()).find(|&k| chars[k] == '\n').unwrap_or(chars.len());
        } else if c == '/' && at(i + 1) == '*' {
            i = end_of_comment(&chars, i);
        } else if let Some(end) = end_of_string(&chars, i) {
            i = end;
        } else if c == '\'' {
            // 'x', '\n' and '\u{1f}' are characters, 'name is a lifetime.
            let escaped = at(i + 1) == '\\';
            if escaped || at(i + 2) == '\'' {
                let from = i + 2 + usize::from(escaped);
                i = (from..chars.len()).find(|&k| chars[k] == '\'').map_or(chars.len(), |k| k + 1);
            } else {
                i += 1;
                while word_char(at(i)) {
                    i += 1;
                }
            }
        } else if word_char(c) {
            let number = c.is_ascii_digit();
            while word_char(at(i)) || (number && at(i) == '.' && at(i + 1).is_ascii_digit()) {
                i += 1;
            }
        } else if (c == ':' && at(i + 1) == ':') || (c == '-' && at(i + 1) == '>') {
            i += 2;
        } else {
            i += 1;
        }
        let written: String = chars[start..i].iter().collect();
        if !c.is_whitespace() && !written.starts_with("//") && !written.starts_with("/*") {
            out.push(Token { text: written.clone(), line });
        }
        line += written.matches('\n').count();
    }
    out
}

fn word_char(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

fn end_of_comment(chars: &[char], from: usize) -> usize {
    let (mut depth, mut i) = (0, from);
    while i < chars.len() {
        match (chars[i], chars.get(i + 1)) {
            ('/', Some('*')) => (depth, i) = (depth + 1, i + 2),
            ('*', Some('/')) => (depth, i) = (depth - 1, i + 2),
            _ => i += 1,
        }
        if depth == 0 {
            break;
        }
    }
    i
}

/// Where the string literal that begins at `from` ends, if one begins there: `"…"`, `b"…"`, `c"…"`, `r#"…"#`.
fn end_of_string(chars: &[char], from: usize) -> Option<usize> {
    let mut i = from;
    while matches!(chars.get(i), Some('b' | 'c' | 'r')) && i < from + 2 {
        i += 1;
    }
    let raw = i > from && chars[i - 1] == 'r';
    let hashes = if raw { chars[i..].iter().take_while(|&&c| c == '#').count() } else { 0 };
    i += hashes;
    if chars.get(i) != Some(&'"') {
        return None;
    }
    i += 1;
    while i < chars.len() {
        let closes = chars[i] == '"'
            && chars[i + 1..].iter().take(hashes).filter(|&&c| c == '#').count() == hashes;
        if closes {
            return Some(i + 1 + hashes);
        }
        i += if chars[i] == '\\' && !raw { 2 } else { 1 };
    }
    Some(i)
}

/// `tokens` without what stands behind `#[cfg(test)]`, and the first and last line of each such part.
pub fn without_tests(tokens: &[Token]) -> (Vec<Token>, Vec<(usize, usize)>) {
    const MARK: [&str; 7] = ["#", "[", "cfg", "(", "test", ")", "]"];
    let (mut kept, mut tests, mut i) = (Vec::new(), Vec::new(), 0);
    while i < tokens.len() {
        let marked = tokens.len() - i >= MARK.len()
            && MARK.iter().zip(&tokens[i..]).all(|(mark, token)| *mark == token.text);
        if marked {
            let end = end_of_item(tokens, i + MARK.len());
            tests.push((tokens[i].line, tokens[end - 1].line));
            i = end;
        } else {
            kept.push(tokens[i].clone());
            i += 1;
        }
    }
    (kept, tests)
}

/// Index behind the item, statement or field that begins at `from`.
fn end_of_item(tokens: &[Token], from: usize) -> usize {
    const ITEMS: [&str; 14] = [
        "pub",
        "fn",
        "impl",
        "mod",
        "use",
        "struct",
        "enum",
        "const",
        "static",
        "async",
        "unsafe",
        "type",
        "trait",
        "macro_rules",
    ];
    let mut i = from;
    while tokens.get(i).is_some_and(|t| t.text == "#") {
        i = closing(tokens, i + 1) + 1;
    }
    let item = tokens.get(i).is_some_and(|t| ITEMS.contains(&t.text.as_str()));
    let through_semicolon = tokens.get(i).is_some_and(|t| t.text == "use" || t.text == "const");
    while i < tokens.len() {
        match tokens[i].text.as_str() {
            ";" => return i + 1,
            "," if !item => return i + 1,
            "{" if !through_semicolon => return closing(tokens, i) + 1,
            "{" | "(" | "[" => i = closing(tokens, i),
            _ => {}
        }
        i += 1;
    }
    i
}

/// Index of the bracket that closes the one at `open`.
pub fn closing(tokens: &[Token], open: usize) -> usize {
    let mut depth = 0;
    for (i, token) in tokens.iter().enumerate().skip(open) {
        match token.text.as_str() {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return i;
        }
    }
    tokens.len() - 1
}

#[test]
fn comments_strings_and_tests_are_left_out() {
    let text = r####"
        /// Doc with "quotes".
        fn f<'a>(x: &'a str) -> char { let s = r#"a " b // c"#; /* x /* y */ z */ '"' }
        #[cfg(test)]
        mod tests { fn g() {} }
        struct S { #[cfg(test)] hook: fn(u8, u8), kept: f32, }
        #[cfg(test)]
        use a::{b, c};
        const N: f64 = 1.5e-3;
    "####;
    let (kept, tests) = without_tests(&read(text));
    let words: Vec<&str> = kept.iter().map(|t| t.text.as_str()).collect();
    assert_eq!(
        words.join(" "),
        "fn f < 'a > ( x : & 'a str ) -> char { let s = r#\"a \" b // c\"# ; '\"' } \
         struct S { kept : f32 , } const N : f64 = 1.5e - 3 ;"
    );
    assert_eq!(tests, [(4, 5), (6, 6), (7, 8)]);
}
