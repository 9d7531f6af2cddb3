within Drives;
package Components "Rotational components of a geared drive"
end Components;
