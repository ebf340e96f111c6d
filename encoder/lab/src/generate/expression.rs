//! Arithmetic of object files: numbers, names, `+ - * /`, parentheses, and `rand`.

use slag_math::random::Xorshift;

#[derive(Clone, Debug, PartialEq)]
pub enum Expression {
    Number(f64),
    /// A variable, by its index among the names.
    Variable(usize),
    /// A new random number in -1..1 at each evaluation.
    Random,
    Minus(Box<Expression>),
    Binary(Operator, Box<[Expression; 2]>),
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Operator {
    Add,
    Subtract,
    Multiply,
    Divide,
}

impl Expression {
    pub fn parse(text: &str, names: &[String]) -> Result<Self, String> {
        let mut parser = Parser { rest: text.trim(), names, depth: 0 };
        let expression = parser.sum()?;
        match parser.rest {
            "" => Ok(expression),
            rest => Err(format!("`{rest}` after an expression, expected an operator or the end")),
        }
    }

    /// `variables` are in the order of the names.
    pub fn value(&self, variables: &[f64], random: &mut Xorshift) -> f64 {
        match self {
            Self::Number(number) => *number,
            Self::Variable(index) => variables[*index],
            Self::Random => random.signed(),
            Self::Minus(operand) => -operand.value(variables, random),
            Self::Binary(operator, operands) => {
                let [a, b] = [0, 1].map(|i| operands[i].value(variables, random));
                match operator {
                    Operator::Add => a + b,
                    Operator::Subtract => a - b,
                    Operator::Multiply => a * b,
                    Operator::Divide => a / b,
                }
            }
        }
    }
}

const MAX_DEPTH: usize = 64;

struct Parser<'a> {
    rest: &'a str,
    names: &'a [String],
    depth: usize,
}

impl Parser<'_> {
    fn take<T: Copy>(&mut self, symbols: &[(char, T)]) -> Option<T> {
        let first = self.rest.chars().next()?;
        let (_, meaning) = symbols.iter().find(|(symbol, _)| *symbol == first)?;
        self.rest = self.rest[first.len_utf8()..].trim_start();
        Some(*meaning)
    }

    fn sum(&mut self) -> Result<Expression, String> {
        let mut left = self.product()?;
        while let Some(operator) = self.take(&[('+', Operator::Add), ('-', Operator::Subtract)]) {
            left = Expression::Binary(operator, Box::new([left, self.product()?]));
        }
        Ok(left)
    }

    fn product(&mut self) -> Result<Expression, String> {
        let mut left = self.operand()?;
        while let Some(operator) = self.take(&[('*', Operator::Multiply), ('/', Operator::Divide)]) {
            left = Expression::Binary(operator, Box::new([left, self.operand()?]));
        }
        Ok(left)
    }

    fn operand(&mut self) -> Result<Expression, String> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(format!("more than {MAX_DEPTH} nested parentheses and signs"));
        }
        let operand = if self.take(&[('-', ())]).is_some() {
            Expression::Minus(Box::new(self.operand()?))
        } else if self.take(&[('(', ())]).is_some() {
            let inner = self.sum()?;
            self.take(&[(')', ())]).ok_or_else(|| format!("`{}`, expected `)`", self.rest))?;
            inner
        } else {
            let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
            let end = self.rest.find(|c| !is_word(c)).unwrap_or(self.rest.len());
            let word = &self.rest[..end];
            let operand = if word == "rand" {
                Expression::Random
            } else if let Some(index) = self.names.iter().position(|name| name == word) {
                Expression::Variable(index)
            } else if let Some(number) = word.parse().ok().filter(|number: &f64| number.is_finite()) {
                Expression::Number(number)
            } else {
                return Err(format!("`{}`, expected a number, a name or `(`", self.rest));
            };
            self.rest = self.rest[end..].trim_start();
            operand
        };
        self.depth -= 1;
        Ok(operand)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arithmetic_follows_its_rules() {
        let names = ["w".to_owned(), "half_w".to_owned()];
        let value =
            |text: &str| Expression::parse(text, &names).map(|e| e.value(&[3.0, 1.5], &mut Xorshift::new(1)));
        assert_eq!(value("1 - 2 - 3"), Ok(-4.0));
        assert_eq!(value("2 + 3 * -w"), Ok(-7.0));
        assert_eq!(value("-(w/2 - .5)*4 / half_w"), Ok(-4.0 / 1.5));
        assert!(value("rand").is_ok_and(|x| (-1.0..1.0).contains(&x)));
        for wrong in ["", "1 +", "(1", "1)", "h", "1 2", "inf", "nan", "w w", &"(".repeat(1000)] {
            assert!(value(wrong).is_err(), "{wrong}");
        }
    }
}
