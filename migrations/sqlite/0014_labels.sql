-- What a scene is filed under (JSON: names and values): a building, a floor, a customer.
ALTER TABLE scenes ADD COLUMN labels TEXT NOT NULL DEFAULT '{}';
