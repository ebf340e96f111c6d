//! The text cleaning of OpenAI's CLIP before its tokenizer, which `tokenizer.json` files omit.
//!
//! As ftfy and `html.unescape` do with ordinary input, it replaces character references, UTF-8 read as Windows-1252,
//! curly quotes, ligatures and full-width forms, removes control characters, and collapses spaces.
//!
//! Not the crate `html-escape`: its table of over 2,000 names adds some 0.2 MB to the robot's program, and it keeps
//! references to control characters.

/// Returns `text` cleaned, trimmed, with single spaces.
pub fn clean(text: &str) -> String {
    // CLIP unescapes twice, after ftfy has done it once.
    let unescaped = unescape(&unescape(&unescape(text)));
    let mut cleaned = String::with_capacity(unescaped.len());
    for c in repair_encoding(&unescaped).chars() {
        match c {
            '\u{2bc}' | '\u{2018}'..='\u{201b}' => cleaned.push('\''),
            '\u{201c}'..='\u{201f}' => cleaned.push('"'),
            '\u{fb00}'..='\u{fb06}' => {
                cleaned.push_str(["ff", "fi", "fl", "ffi", "ffl", "ſt", "st"][c as usize - 0xfb00]);
            }
            // Full-width forms are in the order of ASCII.
            '\u{ff01}'..='\u{ff5e}' => cleaned.extend(char::from_u32(c as u32 - 0xff01 + 0x21)),
            '\u{feff}' | '\u{206a}'..='\u{206f}' | '\u{fff9}'..='\u{fffc}' => {}
            c if c.is_control() && !c.is_whitespace() => {}
            c => cleaned.push(c),
        }
    }
    cleaned.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Names of U+00A0 to U+00FF in HTML 4, in order.
const LATIN_1_NAMES: &str = "nbsp iexcl cent pound curren yen brvbar sect uml copy ordf laquo not shy reg macr deg plusmn sup2 \
    sup3 acute micro para middot cedil sup1 ordm raquo frac14 frac12 frac34 iquest Agrave Aacute Acirc Atilde Auml Aring \
    AElig Ccedil Egrave Eacute Ecirc Euml Igrave Iacute Icirc Iuml ETH Ntilde Ograve Oacute Ocirc Otilde Ouml times Oslash \
    Ugrave Uacute Ucirc Uuml Yacute THORN szlig agrave aacute acirc atilde auml aring aelig ccedil egrave eacute ecirc euml \
    igrave iacute icirc iuml eth ntilde ograve oacute ocirc otilde ouml divide oslash ugrave uacute ucirc uuml yacute thorn \
    yuml";

const OTHER_NAMES: &str = "amp lt gt quot apos euro ndash mdash lsquo rsquo ldquo rdquo hellip bull";
/// Their characters.
const OTHERS: &str = "&<>\"'€–—‘’“”…•";

/// Replaces HTML character references that end in a semicolon.
fn unescape(text: &str) -> String {
    let mut result = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find('&') {
        let (before, reference) = rest.split_at(start);
        result.push_str(before);
        // The longest name has 8 letters; the longest number is "#x10ffff".
        let end = reference.bytes().take(10).position(|b| b == b';');
        match end.and_then(|end| Some((end, referenced(&reference[1..end])?))) {
            Some((end, c)) => {
                result.push(c);
                rest = &reference[end + 1..];
            }
            None => {
                result.push('&');
                rest = &reference[1..];
            }
        }
    }
    result + rest
}

fn referenced(name: &str) -> Option<char> {
    if let Some(number) = name.strip_prefix('#') {
        let code = match number.strip_prefix(['x', 'X']) {
            Some(digits) => u32::from_str_radix(digits, 16),
            None => number.parse(),
        };
        return char::from_u32(code.ok()?);
    }
    let place = |names: &str| names.split_ascii_whitespace().position(|n| n == name);
    let latin_1 = place(LATIN_1_NAMES).and_then(|i| char::from_u32(0xa0 + i as u32));
    latin_1.or_else(|| OTHERS.chars().nth(place(OTHER_NAMES)?))
}

/// Undoes UTF-8 read as Windows-1252 for U+0080 to U+00FF and U+2000 to U+203F: accents and quotes of western text.
/// Other lead bytes also occur in correct text ("CAFÉ”").
fn repair_encoding(text: &str) -> String {
    let chars: Vec<char> = text.chars().collect();
    let mut result = String::with_capacity(text.len());
    let mut i = 0;
    while i < chars.len() {
        let n = match chars[i..] {
            ['Â' | 'Ã', ..] => 2,
            ['â', '€', ..] => 3,
            _ => 1,
        };
        let bytes: Option<Vec<u8>> =
            chars.get(i..i + n).and_then(|c| c.iter().map(|&c| windows_1252(c)).collect());
        match bytes.filter(|_| n > 1).and_then(|bytes| String::from_utf8(bytes).ok()) {
            Some(repaired) => {
                result.push_str(&repaired);
                i += n;
            }
            None => {
                result.push(chars[i]);
                i += 1;
            }
        }
    }
    result
}

/// Returns a character's byte in Windows-1252; the five unassigned bytes map to themselves.
fn windows_1252(c: char) -> Option<u8> {
    const FROM_0X80: &str = "€\u{81}‚ƒ„…†‡ˆ‰Š‹Œ\u{8d}Ž\u{8f}\u{90}‘’“”•–—˜™š›œ\u{9d}žŸ";
    FROM_0X80
        .chars()
        .position(|other| other == c)
        .map(|i| 0x80 + i as u8)
        .or_else(|| u8::try_from(c as u32).ok())
}
