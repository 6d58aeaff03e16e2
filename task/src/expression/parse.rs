//! From text to a tree. The grammar, loosest first: `a < b` (also `>`, `<=`, `>=`), `a + b`, `a * b`, `-a`,
//! `a ^ 2`, `a.name`, `f(a, b)`, numbers, names and brackets.

/// Longest text of an expression, bytes.
const TEXT_MAX: usize = 1000;
/// Deepest nesting.
const DEPTH_MAX: usize = 40;

/// A parsed expression.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Tree {
    Number(f32),
    Name(String),
    /// `of.member`: x, y, z, a joint or a foot.
    Member(Box<Tree>, String),
    Negative(Box<Tree>),
    Power(Box<Tree>, i16),
    Binary(Infix, Box<Tree>, Box<Tree>),
    Call(String, Vec<Tree>),
}

/// What stands between two operands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Infix {
    Plus,
    Minus,
    Times,
    Over,
    Less,
    LessOrEqual,
}

pub(super) fn parse(text: &str) -> Result<Tree, String> {
    if text.len() > TEXT_MAX {
        return Err(format!("is longer than {TEXT_MAX} bytes"));
    }
    let mut parser = Parser { rest: text, depth: 0 };
    let tree = parser.comparison()?;
    match parser.peek() {
        None => Ok(tree),
        Some(_) => Err(format!("cannot be read from `{}` on", parser.rest.trim())),
    }
}

struct Parser<'a> {
    rest: &'a str,
    depth: usize,
}

impl<'a> Parser<'a> {
    fn peek(&mut self) -> Option<char> {
        self.rest = self.rest.trim_start();
        self.rest.chars().next()
    }

    /// Takes `word` if it comes next.
    fn take(&mut self, word: &str) -> bool {
        self.peek();
        match self.rest.strip_prefix(word) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    fn take_while(&mut self, belongs: impl Fn(char) -> bool) -> &'a str {
        let end = self.rest.find(|c| !belongs(c)).unwrap_or(self.rest.len());
        let (taken, rest) = self.rest.split_at(end);
        self.rest = rest;
        taken
    }

    fn comparison(&mut self) -> Result<Tree, String> {
        self.depth += 1;
        if self.depth > DEPTH_MAX {
            return Err(format!("is nested deeper than {DEPTH_MAX}"));
        }
        let left = self.sum()?;
        let found = [
            ("<=", Infix::LessOrEqual, false),
            (">=", Infix::LessOrEqual, true),
            ("<", Infix::Less, false),
            (">", Infix::Less, true),
        ]
        .into_iter()
        .find(|(word, ..)| self.take(word));
        let tree = match found {
            None => left,
            Some((_, infix, turned)) => {
                let right = self.sum()?;
                let (a, b) = if turned { (right, left) } else { (left, right) };
                Tree::Binary(infix, a.into(), b.into())
            }
        };
        self.depth -= 1;
        Ok(tree)
    }

    fn sum(&mut self) -> Result<Tree, String> {
        self.chain([('+', Infix::Plus), ('-', Infix::Minus)], Self::product)
    }

    fn product(&mut self) -> Result<Tree, String> {
        self.chain([('*', Infix::Times), ('/', Infix::Over)], Self::unary)
    }

    /// Parts that `infixes` stand between, from the left.
    fn chain(
        &mut self,
        infixes: [(char, Infix); 2],
        part: fn(&mut Self) -> Result<Tree, String>,
    ) -> Result<Tree, String> {
        let mut tree = part(self)?;
        while let Some((_, infix)) = infixes.into_iter().find(|(c, _)| self.peek() == Some(*c)) {
            self.rest = &self.rest[1..];
            tree = Tree::Binary(infix, tree.into(), part(self)?.into());
        }
        Ok(tree)
    }

    fn unary(&mut self) -> Result<Tree, String> {
        let mut signs = 0;
        while self.take("-") {
            signs += 1;
        }
        let tree = self.power()?;
        Ok(match signs % 2 {
            0 => tree,
            _ => Tree::Negative(tree.into()),
        })
    }

    fn power(&mut self) -> Result<Tree, String> {
        let tree = self.member()?;
        if !self.take("^") {
            return Ok(tree);
        }
        self.peek();
        let digits = self.take_while(|c| c.is_ascii_digit());
        match digits.parse::<i16>() {
            Ok(power @ 1..=8) => Ok(Tree::Power(tree.into(), power)),
            _ => Err("has a power that is not a whole number from 1 to 8".to_owned()),
        }
    }

    fn member(&mut self) -> Result<Tree, String> {
        let mut tree = self.primary()?;
        while self.take(".") {
            let name = self.name();
            if name.is_empty() {
                return Err("has a `.` without a name behind it".to_owned());
            }
            tree = Tree::Member(tree.into(), name.to_owned());
        }
        Ok(tree)
    }

    fn name(&mut self) -> &'a str {
        self.take_while(|c| c.is_ascii_alphanumeric() || c == '_')
    }

    fn primary(&mut self) -> Result<Tree, String> {
        match self.peek() {
            None => Err("ends where a number, a name or a bracket must come".to_owned()),
            Some('(') => {
                self.take("(");
                let tree = self.comparison()?;
                self.close()?;
                Ok(tree)
            }
            Some(c) if c.is_ascii_digit() || c == '.' => self.number(),
            Some(c) if c.is_ascii_alphabetic() || c == '_' => {
                let name = self.name();
                if !self.take("(") {
                    return Ok(Tree::Name(name.to_owned()));
                }
                let mut arguments = vec![self.comparison()?];
                while self.take(",") {
                    arguments.push(self.comparison()?);
                }
                self.close()?;
                Ok(Tree::Call(name.to_owned(), arguments))
            }
            Some(c) => Err(format!("has a `{c}` that means nothing here")),
        }
    }

    fn close(&mut self) -> Result<(), String> {
        if self.take(")") { Ok(()) } else { Err("has a bracket that is not closed".to_owned()) }
    }

    fn number(&mut self) -> Result<Tree, String> {
        let whole = self.rest;
        let digits = |parser: &mut Self| parser.take_while(|c| c.is_ascii_digit()).len();
        digits(self);
        if self.rest.starts_with('.') {
            self.rest = &self.rest[1..];
            digits(self);
        }
        if self.rest.starts_with(['e', 'E']) {
            let before = self.rest;
            self.rest = &self.rest[1..];
            if self.rest.starts_with(['+', '-']) {
                self.rest = &self.rest[1..];
            }
            if digits(self) == 0 {
                self.rest = before;
            }
        }
        let text = &whole[..whole.len() - self.rest.len()];
        match text.parse::<f32>() {
            Ok(value) if value.is_finite() => Ok(Tree::Number(value)),
            _ => Err(format!("has `{text}`, which is no number")),
        }
    }
}
