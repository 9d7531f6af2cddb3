within Drives;
package Functions "Laws of friction"
end Functions;
