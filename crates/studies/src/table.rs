//! Tables that are printed, and stand on pages as well.

use std::fmt::Write;

/// Words in rows; the first column names the row.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// The heading of each column. The first one says what the table is of.
    pub head: Vec<String>,
    /// The rows.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// As HTML. The words are the program's own.
    pub fn html(&self) -> String {
        let mut html = String::from("<div class=\"scroll\"><table><thead><tr>");
        for head in &self.head {
            let _ = write!(html, "<th>{head}</th>");
        }
        html.push_str("</tr></thead><tbody>");
        for row in &self.rows {
            html.push_str("<tr>");
            for cell in row {
                let _ = write!(html, "<td>{cell}</td>");
            }
            html.push_str("</tr>");
        }
        html + "</tbody></table></div><br>"
    }
}
